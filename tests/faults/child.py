"""A process that runs commands of ours and kills itself before a call of a given number.

Arguments: the folder whose calls are numbered; the number of the call, 0 for none; the file for the calls; then the words of
the commands, those of one command after those of another with a ``+`` between. Each command numbers its calls anew, and
only the last one is killed. ``keep A B`` copies a folder.
"""

import hashlib
import itertools
import os
import shutil
import sys
from pathlib import Path

from tests.faults.calls import Call, numbered
from warpgs.app.cli import main
from warpgs.pipeline.runs import results


def run(root: Path, at: int, trace: Path, commands: list[list[str]]) -> int:
    """Run commands; returns the exit code of the first that fails, or 0."""
    results.render_overview = lambda *_: (None, "no overview image: this is a test")
    with trace.open("wb", buffering=0) as log:
        for words in commands:
            if words[0] == "keep":
                shutil.copytree(*words[1:])
                continue
            log.write(f"command {words[0]}\n".encode())
            last = words is commands[-1]

            def before(call: Call, last: bool = last) -> None:
                digest = ""
                if call.source is not None and call.source.is_file():
                    digest = hashlib.sha256(call.source.read_bytes()).hexdigest()
                log.write(f"{call.kind}\t{os.path.relpath(call.path, root)}\t{digest}\n".encode())
                if last and call.number == at:
                    if call.half is not None:
                        call.half()
                    os.kill(os.getpid(), 9)  # SIGKILL; on Windows the end of the process

            with numbered(root, before):
                code = main(words)
            if code:
                return code
    return 0


if __name__ == "__main__":
    groups = [list(g) for plus, g in itertools.groupby(sys.argv[4:], lambda w: w == "+") if not plus]
    sys.exit(run(Path(os.path.realpath(sys.argv[1])), int(sys.argv[2]), Path(sys.argv[3]), groups))
