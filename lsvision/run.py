"""The command line: ``python -m lsvision.run +experiment=paper``."""

from lsvision.interruption import interruptible


def main() -> None:
    """Run one command; an expected failure is one line and its exit code, and so is an interruption."""
    with interruptible():
        from lsvision.experiments.command import run_command  # takes its time, in which Ctrl-C is a line too

        run_command()


if __name__ == "__main__":
    main()
