"""The console script: `ommatid`, or `python -m ommatid`."""

from ommatid.runtime.execution.interpreter import leave_current_folder


def main() -> None:
    """Run the command line and exit."""
    leave_current_folder()  # before anything else is imported
    from ommatid.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
