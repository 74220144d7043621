"""`python -m alidade` is the command `alidade`."""

from pipelines.cli import main

main()
