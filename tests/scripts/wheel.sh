#!/usr/bin/env bash
# Builds sdists and wheels of both distributions as an index takes them, and uses the wheels from
# outside the repository: in an environment of its own, beside the packages of the one that runs this.
#   tests/scripts/wheel.sh FOLDER
set -euo pipefail
cd "$(dirname "$0")/../.."
folder="$1"

export PIMPER_BENCH=""
for distribution in . benchmarks; do
    python -m build --no-isolation --outdir "$folder/dist" "$distribution" > /dev/null
done
if tar -xzOf "$folder"/dist/pimper_torch-*.tar.gz --wildcards "*/PKG-INFO" \
    | grep "^Requires-Dist:.* @ "; then
    echo "an index refuses what refers to a place" >&2
    exit 1
fi
twine check --strict "$folder"/dist/*
python -m venv --without-pip "$folder/venv"
outside="$folder/venv/bin/python"
here="$(python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
there="$("$outside" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
echo "$here" > "$there/beside.pth"
pip --python "$outside" install --quiet --no-deps --force-reinstall "$folder"/dist/*.whl

cp tests/scripts/from_outside.py "$folder"
cd "$folder"
env -u PYTHONPATH "$folder/venv/bin/pimper" --version
env -u PYTHONPATH "$folder/venv/bin/pimper" render --help > /dev/null
env -u PYTHONPATH "$outside" from_outside.py "$there"
# Others' types take long to read and are not what is checked.
printf '[mypy]\nstrict = True\n[mypy-torch.*,numpy.*,scipy.*,matplotlib.*,trimesh.*,PIL.*]\n%s\n' \
    'follow_imports = skip' > mypy.ini
env -u PYTHONPATH mypy --config-file mypy.ini --python-executable "$outside" from_outside.py
