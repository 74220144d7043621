"""`python -m alidade` is the command `alidade`."""

from alidade.pipelines.cli import main

main()
