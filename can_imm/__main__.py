"""``python -m can_imm`` is ``can-imm``."""

import sys

from can_imm.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
