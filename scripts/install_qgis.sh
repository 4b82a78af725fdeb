#!/usr/bin/env bash
# QGIS, and .qgis: an environment in which its Python runs pytest.
#
#   scripts/install_qgis.sh [--if-possible]
#
# On Debian 12 without QGIS 3.34 or later, QGIS comes from bookworm-backports (root); elsewhere it must be there already.
# .qgis sees only the packages that QGIS itself needs. --if-possible ends without an error where this cannot work, except
# with CI=true.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$PWD/.qgis python=/usr/bin/python3

give_up() {
  echo "The QGIS tests are skipped: $1" >&2
  [ "$if_possible" = 1 ] && [ "${CI:-}" != true ] && exit 0
  exit 1
}
if_possible=0
[ "${1:-}" = --if-possible ] && if_possible=1

has_qgis() { "$1" -c 'import qgis.core, sys; sys.exit(qgis.core.Qgis.QGIS_VERSION_INT < 33400)' 2>/dev/null; }
has_all() { has_qgis "$python" && command -v qgis_process >/dev/null; }

install_packages() {
  [ "$(. /etc/os-release 2>/dev/null && echo "${ID:-}${VERSION_ID:-}")" = debian12 ] ||
    give_up "there is no QGIS 3.34 or later, and this is not Debian 12. Install QGIS."
  [ "$(id -u)" = 0 ] || give_up "there is no QGIS 3.34 or later, and installing it needs root."
  local sources=/etc/apt/sources.list.d mirror
  mirror=$(cat $sources/*.sources /etc/apt/sources.list 2>/dev/null |
    awk '/^URIs:/ { print $2; exit } /^deb / { sub(/\[[^]]*\] */, ""); print $2; exit }')
  if ! grep -rqs 'bookworm-backports' /etc/apt/sources.list $sources; then
    printf 'Types: deb\nURIs: %s\nSuites: bookworm-backports\nComponents: main\nSigned-By: %s\n' \
      "${LODA_DEBIAN_MIRROR:-${mirror:-http://deb.debian.org/debian}}" /usr/share/keyrings/debian-archive-keyring.gpg \
      > $sources/bookworm-backports.sources
  fi
  echo "Installing QGIS from bookworm-backports (about two minutes)"
  export DEBIAN_FRONTEND=noninteractive
  apt-get -qq -o DPkg::Lock::Timeout=300 update >/dev/null || give_up "the package lists cannot be fetched."
  apt-get -qq -o DPkg::Lock::Timeout=300 install -y --no-install-recommends -t bookworm-backports \
    qgis python3-qgis qgis-providers python3-venv >/dev/null || give_up "the packages cannot be installed."
}

make_environment() {
  local packages name
  rm -rf "$venv" "$venv.part"
  "$python" -m venv "$venv"
  "$venv/bin/python" -m pip install --quiet pytest
  packages=$("$python" -c 'import os, qgis; print(os.path.dirname(os.path.dirname(qgis.__file__)))')
  mkdir "$venv/system"
  for name in qgis PyQt5 PyQt6 osgeo yaml _yaml psycopg2; do
    if [ -e "$packages/$name" ]; then ln -s "$packages/$name" "$venv/system/$name"; fi
  done
  echo "$venv/system" > "$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/qgis.pth"
}

has_all || install_packages
if ! has_qgis "$venv/bin/python" || ! "$venv/bin/python" -c 'import pytest' 2>/dev/null; then make_environment; fi
has_qgis "$venv/bin/python" || give_up "the Python of QGIS cannot be used from an environment."
