#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Install the simulator `torcs`: build its host into build/torcs and install plugins/ds_sim_torcs into .venv; `host` as
# argument only builds. The host is built against the installed TORCS and the headers of its source, which no package
# has: they are taken from Debian's source package, 394 MB that are read once and not kept.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
version=1.3.7 # the layout of its structures is compiled in
sum=e496ded17dcae1698abe43bb7b564f7d48082f9bbebd127b0cabb0107191bbbf
mirror=${DS_DEBIAN_MIRROR:-http://deb.debian.org/debian}
packages="torcs libplib-dev libegl-dev libgl-dev g++ curl xz-utils"
headers=('*/src/interfaces/*.h' '*/src/libs/*/*.h' '*/src/linux/*.h')
folder=build/torcs
host=plugins/ds_sim_torcs/host/torcs_host.cpp

stop() {
  echo "torcs: $1" >&2
  exit 1
}

fetch_headers() {
  local from=$mirror/pool/main/t/torcs/torcs_$version+dfsg.orig.tar.xz into=$folder/headers.partial
  rm -rf "$into" "$folder/sum"
  mkdir -p "$into"
  echo "torcs: reading the headers of TORCS $version from $from"
  { curl -fsSL --retry 2 "$from" | tee >(sha256sum | cut -d' ' -f1 >"$folder/sum") |
    tar -xJ -C "$into" --strip-components=2 --wildcards "${headers[@]}"; } 2>"$folder/log" ||
    stop "the source package cannot be read: is $mirror reachable? DS_DEBIAN_MIRROR names another ($folder/log)"
  while [ ! -s "$folder/sum" ]; do sleep 0.1; done
  [ "$(cat "$folder/sum")" = $sum ] || stop "the source package has another SHA-256 than expected: use Debian's own"
  ln -s libs/math "$into/tmath" # by this name it is included
  mv "$into" "$folder/headers"
}

found=$(dpkg-query -W -f '${Version}' torcs 2>/dev/null || true)
[ -n "$found" ] || stop "TORCS is not installed: sudo apt-get install -y $packages"
case $found in "$version"*) ;; *) stop "TORCS $found is installed, expected $version" ;; esac
lib=$(dirname "$(dpkg -L torcs | grep '/modules/simu/simuv2.so$')")/../..
lib=$(realpath "$lib")
for needed in /usr/include/plib/ssg.h /usr/include/EGL/egl.h /usr/include/GL/gl.h; do
  [ -f $needed ] || stop "$needed is missing: sudo apt-get install -y $packages"
done
for program in g++ curl xz; do
  command -v $program >/dev/null || stop "$program is missing: sudo apt-get install -y $packages"
done
mkdir -p $folder
[ -d $folder/headers ] || fetch_headers

build() {
  system=$(dirname "$lib")
  includes=("-I$folder/headers")
  for part in interfaces libs/tgf libs/robottools libs/portability libs/tgfclient linux; do
    includes+=("-I$folder/headers/$part")
  done
  source=$(sha256sum $host)
  # Debian has no links of libraries without their development packages: the libraries themselves are named.
  g++ -O2 -std=c++17 -w "-DSOURCE=\"${source:0:12}\"" "${includes[@]}" -o $folder/torcs_host.partial $host \
    -rdynamic -Wl,--no-as-needed \
    -L"$lib/lib" -Wl,-rpath,"$lib/lib" -ltgf -ltxml -ltgfclient -lrobottools \
    -lplibssgaux -lplibssg -lplibsg -lplibul -lplibjs -lGL -lEGL \
    "$(ls "$system"/libGLU.so.1* | head -n 1)" "$(ls "$system"/libglut.so.3* | head -n 1)" \
    "$system/libpng16.so.16" "$system/libz.so.1" "$system/libX11.so.6" "$system/libXrandr.so.2" -ldl
  mv $folder/torcs_host.partial $folder/torcs_host
  echo "torcs: $folder/torcs_host"
}

[ $folder/torcs_host -nt $host ] || build
[ "${1:-}" != host ] || exit 0
[ -x .venv/bin/python ] || stop ".venv is not there yet: make setup, then make torcs again"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable "${host%/host/*}"
echo "torcs: installed; ./ds doctor lists it"
