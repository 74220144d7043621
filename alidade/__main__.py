"""`python -m alidade` is the command `alidade`."""


def run() -> None:
    """Run the command; an interruption while modules are imported ends it like any other, with exit code 130."""
    try:
        from alidade.pipelines.applications.cli import main
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    main()


if __name__ == "__main__":
    run()
