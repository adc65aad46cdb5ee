import sys

try:
    from sb3_tdc.cli.tune import main
except ImportError as error:
    sys.exit(str(error))

if __name__ == "__main__":
    sys.exit(main())
