"""Under ``torchrun``: every configuration of a folder, once straight and once with a break.

    torchrun --nproc-per-node 2 tests/broken_runs.py FOLDER

``FOLDER/NAME.toml`` is run in ``FOLDER/NAME/whole`` and, stopped after its first step and gone on
with, in ``FOLDER/NAME/broken``. One launch for all of them: starting the processes takes longer
than the few steps.
"""

from __future__ import annotations

import sys
from pathlib import Path

from cvthead.training.config import load_config
from cvthead.training.train import train


def main() -> None:
    folder = Path(sys.argv[1])
    for file in sorted(folder.glob("*.toml")):
        whole, broken = (
            load_config(str(file), {"run": folder / file.stem / kind})
            for kind in ("whole", "broken")
        )
        train(whole)
        train(broken, sitting=1)
        train(broken)


if __name__ == "__main__":
    main()
