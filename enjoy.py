import sys

from sb3_tdc.cli.enjoy import main

if __name__ == "__main__":
    sys.exit(main())
