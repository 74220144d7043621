"""`python -m alidade` is the command `alidade`."""

import sys
import warnings


def run() -> None:
    """Run the command; an interruption while modules are imported ends it like any other, with exit code 130."""
    if not sys.warnoptions:  # what users are to know of readings beyond all range is said in sentences
        warnings.simplefilter("ignore", RuntimeWarning)
    try:
        from alidade.pipelines.applications.cli import main
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    main()


if __name__ == "__main__":
    run()
