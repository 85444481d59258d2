#!/usr/bin/env bash
# Build the wheel, install it in a throw-away virtual environment away from this clone, and try it there.
# Usage: scripts/dist_check.sh PYTHON   (a Python that has the package `build`)
set -euo pipefail
cd "$(dirname "$0")/.."
python=$(realpath --no-symlinks "$1")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

echo "==> building the wheel"
"$python" -m build --wheel --outdir "$scratch" . >"$scratch/build.log" || { cat "$scratch/build.log"; exit 1; }
wheel=$(echo "$scratch"/*.whl)
"$python" -m zipfile --list "$wheel"

echo "==> installing $(basename "$wheel") in a fresh venv"
"$python" -m venv "$scratch/venv"
"$scratch/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$wheel[eval]"
"$scratch/venv/bin/python" -m pip check
cd "$scratch"
"$scratch/venv/bin/vecenv" --version
"$scratch/venv/bin/vecenv" doctor
"$scratch/venv/bin/vecenv" eval --suite libero_object --policy zero --tasks 0 --episodes 1 --max-steps 5 --out "$scratch/out"
echo "==> the wheel works"
