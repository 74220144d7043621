"""`python -m alidade` is the command `alidade`."""

from alidade.pipelines.applications.cli import main

main()
