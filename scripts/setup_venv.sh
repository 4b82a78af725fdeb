#!/usr/bin/env bash
# Makes .venv with loda-pdal (editable) and its development tools; does nothing while pyproject.toml and this script stay the same.
# PYTHON=... chooses the interpreter (3.11 or later).
set -euo pipefail
cd "$(dirname "$0")/.."

is_usable() { "$1" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
  local name
  for name in ${PYTHON:-python3.11 python3.12 python3.13 python3 /usr/bin/python3}; do
    if is_usable "$name"; then echo "$name"; return; fi
  done
  return 1
}

stamp=.venv/.pyproject.sha256
wanted=$(cat pyproject.toml scripts/setup_venv.sh | sha256sum)
if [ -x .venv/bin/python ] && [ "$(cat $stamp 2>/dev/null)" = "$wanted" ]; then exit 0; fi

if [ ! -x .venv/bin/python ]; then
  # Debian keeps venv's installer in a package of its own.
  if ! find_python >/dev/null && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get -q update
    DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300 install -y --no-install-recommends python3-venv
  fi
  python=$(find_python) || { echo "Python 3.11 or later with the venv module is needed; PYTHON=... names one." >&2; exit 1; }
  "$python" -m venv .venv
fi
echo "Installing loda-pdal and its development tools into .venv"
.venv/bin/python -m pip install --quiet --editable '.[dev,bench]'
echo "$wanted" > $stamp
