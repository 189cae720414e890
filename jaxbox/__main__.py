"""Runs the command line as ``python -m jaxbox``, and as ``jaxbox``."""

from jaxbox._interrupts import interruptible, undisturbed


def main() -> None:
    """Runs the command line, which can be interrupted from here on."""
    with interruptible():
        # Libraries in compiled code may end the process where they are interrupted while they are imported.
        with undisturbed():
            from jaxbox.cli import app  # noqa: PLC0415
        app()


if __name__ == "__main__":
    main()
