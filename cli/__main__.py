"""``python -m hybridve.cli`` is the command ``hybridve``."""

from hybridve.cli.main import main

main()
