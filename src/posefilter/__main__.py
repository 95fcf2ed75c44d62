"""`python -m posefilter COMMAND ...`."""

import sys

from posefilter.cli.main import main

sys.exit(main())
