import sys

from sb3_tdc.train import main

if __name__ == "__main__":
    sys.exit(main())
