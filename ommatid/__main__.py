"""The console script: `ommatid`, or `python -m ommatid`."""

from __future__ import annotations

from ommatid.cli.app import main

if __name__ == "__main__":
    main()
