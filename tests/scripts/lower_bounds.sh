#!/usr/bin/env bash
# Installs the packages with the lowest versions that it declares, and reconstructs a small scene.
#
#     tests/scripts/lower_bounds.sh FOLDER
set -euo pipefail
folder="$(mkdir -p "$1" && cd "$1" && pwd)"
root="$(cd "$(dirname "$0")/../.." && pwd)"

"${PYTHON:-python3}" "$root/tests/scripts/lower_bounds.py" > "$folder/constraints.txt"
"${PYTHON:-python3}" -m venv "$folder/venv"
# shellcheck disable=SC1091
source "$folder/venv/bin/activate"
pip install --constraint "$folder/constraints.txt" "torch==2.13.0"
pip install --constraint "$folder/constraints.txt" "$root" "$root/benchmarks"

cd "$folder"  # the installed package, not the working tree
pimper --version
pimper doctor
pimper render jar -o scene --num-views 8 --width 160 --height 120 --processes 1
pimper reconstruct scene/photos -o out --preset fast --sparse scene/truth/sparse
pimper evaluate out scene
