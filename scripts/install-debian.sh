#!/usr/bin/env bash
# Installs the packages of debian-packages.txt that are missing. Needs root; without it, prints what to install.
set -euo pipefail
cd "$(dirname "$0")"

if ! command -v dpkg-query >/dev/null; then
  echo "Not a Debian system: install the counterparts of scripts/debian-packages.txt yourself." >&2
  exit 0
fi

missing=()
optional=()
while read -r name _; do
  case "$name" in "" | "#"*) continue ;; esac
  package=${name%"?"}
  dpkg-query --show --showformat='${Status}' "$package" 2>/dev/null | grep -q "ok installed" && continue
  if [ "$package" = "$name" ]; then missing+=("$package"); else optional+=("$package"); fi
done <debian-packages.txt
[ ${#missing[@]} -gt 0 ] || [ ${#optional[@]} -gt 0 ] || exit 0

if [ "$(id -u)" != 0 ]; then
  echo "Missing Debian packages. Please run: sudo apt-get install ${missing[*]-} ${optional[*]-}" >&2
  exit 0  # what really needs one of them says so itself
fi
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
for package in ${optional[@]+"${optional[@]}"}; do
  apt-cache show "$package" >/dev/null 2>&1 && missing+=("$package")
done
[ ${#missing[@]} -gt 0 ] || exit 0
echo "Installing Debian packages: ${missing[*]}"
apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
