"""The console script: `ommatid`, or `python -m ommatid`."""

from ommatid.runtime.execution.interpreter import leave_current_folder


def main() -> None:
    """Run the command line and exit."""
    leave_current_folder()  # before anything else is imported
    try:
        from ommatid.cli.app import main as run

        run()
    except KeyboardInterrupt:  # before the command began
        raise SystemExit("ommatid: stopped") from None


if __name__ == "__main__":
    main()
