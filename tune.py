import sys

from experiments.tune import main

if __name__ == "__main__":
    sys.exit(main())
