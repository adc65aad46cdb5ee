import sys

from sb3_tdc.safe_load.inspect import main

sys.exit(main())
