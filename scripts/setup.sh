#!/usr/bin/env bash
# Make a virtual environment if it does not exist, and install this clone in it, editable, with one extra.
# Usage: [PYTHON=python3.11] scripts/setup.sh VENV EXTRA
set -euo pipefail
venv=$1 extra=$2
cd "$(dirname "$0")/.."

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
  for candidate in ${PYTHON:-python3.11 python3.12 python3.13 python3 python}; do
    if new_enough "$candidate"; then
      command -v "$candidate"
      return
    fi
  done
  echo "error: vecenv needs Python 3.11 or newer; tried: ${PYTHON:-python3.11 python3.12 python3.13 python3 python}." >&2
  echo "       Install one (Debian, Ubuntu: apt-get install python3 python3-venv), or name it: make PYTHON=/path/to/python3.11" >&2
  return 1
}

if ! new_enough "$venv/bin/python"; then
  python=$(find_python)
  echo "==> making $venv with $("$python" --version)"
  if ! "$python" -m venv --clear "$venv"; then
    echo "error: $python cannot make a virtual environment (Debian, Ubuntu: apt-get install python3-venv)" >&2
    exit 1
  fi
fi

echo "==> installing vecenv[$extra] in $venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".[$extra]"
touch "$venv/.installed-$extra"
