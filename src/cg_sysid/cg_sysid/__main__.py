"""`python -m cg_sysid` is the command `cg`."""

import sys

from cg_sysid.cli.command import main

if __name__ == '__main__':
    sys.exit(main())
