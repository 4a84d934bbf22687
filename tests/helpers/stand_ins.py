"""Stand-ins for the runs of a batch, and for Slurm's commands."""

import sys
from pathlib import Path

# Replaces `pimper`: runs the object's program, with the variables `out` and `tries` (so far).
CHILD = """
import json, os, signal, sys, time
from pathlib import Path
photos, out = Path(sys.argv[3]), Path(sys.argv[5])
begun = out.parent / f"{out.name}.begun"
tries = len(begun.read_text()) if begun.exists() else 0
with begun.open("a") as file:
    file.write("x")
def event(event, **about):
    print(json.dumps({"event": event, **about}), flush=True)
def end():
    (out / ".stages").mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps({"views": 8, "faces": 99, "seconds": 1.5}))
    from pimper_torch.export.result_folder.marker import seal
    seal(out, "result")
def fail(kind, code, message="it is so."):
    event("error", kind=kind, message=message, exit_code=code)
    sys.exit(code)
event("stage-begin", stage="read", seconds_left=12.0)
program = photos / "program.txt"
exec(program.read_text() if program.exists() else "end()")
"""
_COMMANDS = {
    "sbatch": """
import os, subprocess, sys
quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
job = subprocess.Popen(["sh", sys.argv[-1]], start_new_session=True, **quiet)
print("Submitted batch job", job.pid)
""",
    "srun": """
import os, sys
words = sys.argv[1:]
while words[0].startswith("--"):
    del words[: 2 if words[0] in ("--output", "--error") else 1]
told = {"JOB_ID": os.getppid(), "NTASKS": 1, "JOB_NUM_NODES": 1, "JOB_NODELIST": "node7"}
told |= {"PROCID": 0, "LOCALID": 0, "NODEID": 0}
os.environ.update({f"SLURM_{name}": str(value) for name, value in told.items()})
os.environ["SLURMD_NODENAME"] = "node7"
os.execvp(words[0], words)
""",
    "sacct": "print('JobID|State|NodeList')",
    "scancel": "",
}


def children_stand_in(folder: Path) -> str:
    """Return a path; Python processes with it as ``PYTHONPATH`` run stand-ins."""
    import pimper_torch

    (folder / "sitecustomize.py").write_text(
        f"from pimper_torch.cli.batches import task\ntask._CHILD = {CHILD!r}\n"
    )
    return f"{folder}:{Path(pimper_torch.__file__).parents[1]}"


def write_slurm(folder: Path) -> None:
    """Write replacements of Slurm's commands that run jobs immediately on this machine."""
    folder.mkdir()
    for name, code in _COMMANDS.items():
        (folder / name).write_text(f"#!{sys.executable}\n{code}")
        (folder / name).chmod(0o755)
