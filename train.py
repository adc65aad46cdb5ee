import sys

from sb3_tdc.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
