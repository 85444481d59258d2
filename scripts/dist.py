"""Build the wheel and the sdist, check what is in them, and try the wheel in empty virtual environments.

The wheel must have every file that Git tracks in the three packages and nothing else; the sdist must have the same
files and what a wheel is built from. Each Python that is found of those asked for gets a new virtual environment: the
packages are imported without extras, the commands of the core run, and one task is evaluated with the extra ``eval``.
Usage: python scripts/dist.py [--help]
"""

from __future__ import annotations

import argparse
import configparser
import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

REPOSITORY = Path(__file__).resolve().parent.parent
# Folder in the repository -> package in the wheel.
PACKAGES = {"vecenv": "vecenv", "voxposer": "voxposer", "eval/vecenv_eval": "vecenv_eval"}
# Besides the packages, what the sdist has.
SDIST_EXTRA = {"CHANGELOG.md", "LICENSE", "PKG-INFO", "README.md", "pyproject.toml", ".gitignore"}
EVALUATION = ("--suite", "libero_object", "--policy", "pick_place", "--tasks", "0", "--episodes", "1")


class DistError(Exception):
    """A built file is wrong, or does not work; the message says which one and why."""


def tracked_files(repository: Path = REPOSITORY) -> frozenset[str]:
    """Files of the packages that belong to the project, as paths in the repository."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *PACKAGES]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=True)
    return frozenset(name for name in done.stdout.split("\0") if name and (repository / name).is_file())


def in_wheel(files: Iterable[str]) -> frozenset[str]:
    """Paths in the wheel of files of the repository."""
    moved = []
    for name in files:
        folder = next(each for each in PACKAGES if PurePosixPath(name).is_relative_to(each))
        moved.append(str(PACKAGES[folder] / PurePosixPath(name).relative_to(folder)))
    return frozenset(moved)


def check_wheel(path: Path, files: Iterable[str]) -> None:
    """Compare a wheel with the files of the packages, and its commands with its modules.

    Args:
        path: the wheel.
        files: of the packages, as paths in the repository.

    Raises:
        DistError: something is missing, or does not belong there.
    """
    with zipfile.ZipFile(path) as archive:
        names = frozenset(archive.namelist())
        info = next((name.split("/")[0] for name in names if name.split("/")[0].endswith(".dist-info")), "")
        commands = archive.read(f"{info}/entry_points.txt").decode() if f"{info}/entry_points.txt" in names else ""
    packed = frozenset(name for name in names if not name.startswith(f"{info}/"))
    _compare(path, packed, in_wheel(files))
    wanted = {f"{info}/{name}" for name in ("METADATA", "entry_points.txt", "licenses/LICENSE")}
    wanted |= {f"{package}/py.typed" for package in PACKAGES.values()}
    if missing := sorted(wanted - names):
        raise DistError(f"{path.name}: without {', '.join(missing)}")
    parser = configparser.ConfigParser()
    parser.read_string(commands)
    for group in parser.sections():
        for name, target in parser[group].items():
            module = target.split(":")[0].replace(".", "/")
            if not names & {f"{module}.py", f"{module}/__init__.py"}:
                raise DistError(f"{path.name}: the entry point {name} names the module of {target}, which is not in it")


def check_sdist(path: Path, files: Iterable[str]) -> None:
    """Compare an sdist with the files of the packages.

    Raises:
        DistError: something is missing, or does not belong there.
    """
    with tarfile.open(path) as archive:
        names = [member.name for member in archive.getmembers() if member.isfile()]
    packed = frozenset(str(PurePosixPath(*PurePosixPath(name).parts[1:])) for name in names)
    _compare(path, packed - SDIST_EXTRA, frozenset(files))
    if missing := sorted(SDIST_EXTRA - packed - {".gitignore"}):
        raise DistError(f"{path.name}: without {', '.join(missing)}")


def _compare(path: Path, packed: frozenset[str], wanted: frozenset[str]) -> None:
    if missing := sorted(wanted - packed):
        raise DistError(f"{path.name}: {len(missing)} files are missing: {', '.join(missing[:10])}")
    if strange := sorted(packed - wanted):
        raise DistError(f"{path.name}: {len(strange)} files do not belong there: {', '.join(strange[:10])}")


def build(out: Path, repository: Path = REPOSITORY) -> tuple[Path, Path]:
    """Build the sdist, and the wheel from it; returns wheel and sdist.

    Raises:
        DistError: the build failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        _run([sys.executable, "-m", "build", "--outdir", folder, "."], cwd=repository)
        out.mkdir(parents=True, exist_ok=True)
        for old in [*out.glob("vecenv-*.whl"), *out.glob("vecenv-*.tar.gz")]:
            old.unlink()
        made = [Path(shutil.move(file, out)) for file in sorted(Path(folder).iterdir())]
    wheel, sdist = (next(file for file in made if file.name.endswith(end)) for end in (".whl", ".tar.gz"))
    return wheel, sdist


def find_python(version: str) -> Path | None:
    """An interpreter of a version such as "3.12": from PATH, or the newest of pyenv's; None where there is none."""
    on_path = shutil.which(f"python{version}")
    root = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    patches = {name.rpartition(".")[2]: root / name for name in (path.name for path in root.glob(f"{version}.*"))}
    newest_first = sorted((int(patch) for patch in patches if patch.isdigit()), reverse=True)
    found = [Path(on_path)] if on_path else []
    found += [patches[str(patch)] / "bin/python" for patch in newest_first]
    return next((path for path in found if _version(path) == version), None)


def _version(python: Path) -> str:
    """What a Python says its version is, "3.12"; empty where it does not start, as pyenv's shims sometimes."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if not done.returncode else ""


def try_wheel(wheel: Path, python: Path) -> None:
    """Install a wheel in an empty virtual environment, import what is in it and run its commands.

    Raises:
        DistError: a command failed; the message has its output.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv, away = Path(folder) / "venv", Path(folder) / "away"
        away.mkdir()
        _run([python, "-m", "venv", venv], cwd=away)
        inside, vecenv = venv / "bin/python", venv / "bin/vecenv"
        install = [inside, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        _run([*install, wheel], cwd=away)
        _run([inside, "-m", "pip", "check"], cwd=away)
        for package in PACKAGES.values():
            _run([inside, "-W", "error", "-c", f"import {package}"], cwd=away)
        for command in ([vecenv, "--help"], [inside, "-m", "vecenv", "--version"], [vecenv, "doctor"]):
            _run(command, cwd=away)
        print(f"    {_version(inside)}: imports and commands without extras: as they should be", flush=True)
        _run([*install, f"{wheel}[eval]"], cwd=away)
        _run([vecenv, "eval", *EVALUATION, "--out", away / "out"], cwd=away)
        print(f"    {_version(inside)}: vecenv eval {' '.join(EVALUATION)}: as it should be", flush=True)


def _run(command: Sequence[str | Path], *, cwd: Path) -> None:
    """Run a command that sees nothing of this clone.

    Raises:
        DistError: it failed.
    """
    environment: Mapping[str, str] = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        raise DistError(f"{' '.join(map(str, command))}: exit status {done.returncode}\n{done.stdout[-4000:]}")


def supported(repository: Path = REPOSITORY) -> list[str]:
    """Versions of Python that the classifiers of the project name."""
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    prefix = "Programming Language :: Python :: 3."
    return [line.split(" :: ")[-1] for line in project["classifiers"] if line.startswith(prefix)]


def main() -> int:
    """Build, check, try; the exit status."""
    parser = argparse.ArgumentParser(description="build and check the wheel and the sdist, and try the wheel")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "dist", help="where they go")
    parser.add_argument("--pythons", nargs="*", default=supported(), help="versions to try, such as 3.12; none: no try")
    options = parser.parse_args()
    try:
        print("==> building", flush=True)
        built = build(options.out)
        files = tracked_files()
        check_wheel(built[0], files)
        check_sdist(built[1], files)
        if importlib.util.find_spec("twine"):
            _run([sys.executable, "-m", "twine", "check", "--strict", *built], cwd=REPOSITORY)
        else:
            print("    twine is not installed: the description is not checked")
        for file in built:
            print(f"    {file}: {file.stat().st_size / 1e6:.1f} MB, {len(files)} files of the packages")
        for version in options.pythons:
            python = find_python(version)
            print(f"==> Python {version}: {python or 'not found, not tried'}", flush=True)
            if python:
                try_wheel(built[0].resolve(), python)
    except DistError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
