"""Entry point of a child process: ``python -m bodycap_batch.tasks [task.json]``."""

import sys

from bodycap_batch.runner.child_main import main
from bodycap_batch.tasks.stages import STAGES

sys.exit(main(sys.argv[1:], {name: stage.run for name, stage in STAGES.items()}))
