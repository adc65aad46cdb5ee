import sys

try:
    from experiments.tune import main
except ImportError as error:
    sys.exit(str(error))

if __name__ == "__main__":
    sys.exit(main())
