"""Slurm's commands as far as submitit uses them: jobs are processes of this machine.

``install(folder)`` writes ``sbatch``, ``srun``, ``sacct``, ``scancel`` and ``scontrol`` into a folder for ``PATH``; all
are this file, which keeps one file a job beside them: its process and, when it has ended, its exit status.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

COMMANDS = ("sbatch", "srun", "sacct", "scancel", "scontrol")


def install(folder: Path) -> Path:
    """Write the commands; returns the folder they are in."""
    folder.mkdir()
    for name in COMMANDS:
        (folder / name).write_text(f"#!{sys.executable}\n" + Path(__file__).read_text())
        (folder / name).chmod(0o755)
    return folder


def sbatch(here: Path, script: str) -> None:
    number = str(1 + max((int(path.name.split("_")[0]) for path in here.glob("*.job")), default=100))
    (here / f"sbatch-{number}.sh").write_text(Path(script).read_text())
    array = re.search(r"^#SBATCH --array=0-(\d+)", Path(script).read_text(), re.MULTILINE)
    for index in range(int(array[1]) + 1) if array else [None]:
        name = number if index is None else f"{number}_{index}"
        environment = {**os.environ, "SLURM_JOB_ID": name, "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
        environment |= {"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_NODEID": "0"}
        if index is not None:
            environment |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": str(index)}
        command = f"bash {here}/sbatch-{number}.sh; echo $? > {here}/{name}.end"
        null = subprocess.DEVNULL
        job = subprocess.Popen(
            ["bash", "-c", command], env=environment, start_new_session=True, stdout=null, stderr=null
        )
        (here / f"{name}.job").write_text(str(job.pid))
    print(f"Submitted batch job {number}")


def srun(arguments: list[str]) -> None:
    while arguments and arguments[0].startswith("-"):
        del arguments[: 1 if arguments[0] == "--unbuffered" else 2]
    os.execvp(arguments[0], arguments)


def sacct(here: Path) -> None:
    print("JobID|State|NodeList")
    for path in here.glob("*.job"):
        end = path.with_suffix(".end")
        state = "RUNNING" if not end.exists() else "COMPLETED" if end.read_text().strip() == "0" else "FAILED"
        print(f"{path.stem}|{state}|here")


def scancel(here: Path, job: str) -> None:
    if not (here / f"{job}.end").exists():
        os.killpg(int((here / f"{job}.job").read_text()), signal.SIGTERM)


def main() -> None:
    here, name, arguments = Path(sys.argv[0]).resolve().parent, Path(sys.argv[0]).name, sys.argv[1:]
    if name == "sbatch":
        sbatch(here, arguments[0])
    elif name == "srun":
        srun(arguments)
    elif name == "sacct":
        sacct(here)
    elif name == "scancel":
        scancel(here, arguments[0])
    else:
        sys.exit(f"{name} is not part of this")


if __name__ == "__main__":
    main()
