"""Entry point of a child process."""

import sys

from bodycap_batch.runner.child import main

sys.exit(main(sys.argv[1:]))
