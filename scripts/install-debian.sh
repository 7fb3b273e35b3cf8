#!/usr/bin/env bash
# Installs the packages of debian-packages.txt that are missing. Needs root; without it, prints what to install.
set -euo pipefail
cd "$(dirname "$0")"

if ! command -v dpkg-query >/dev/null; then
  echo "Not a Debian system: install the counterparts of scripts/debian-packages.txt yourself." >&2
  exit 0
fi

missing=()
while read -r package _; do
  case "$package" in "" | "#"*) continue ;; esac
  dpkg-query --show --showformat='${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing+=("$package")
done <debian-packages.txt
[ ${#missing[@]} -gt 0 ] || exit 0

if [ "$(id -u)" != 0 ]; then
  echo "Missing Debian packages. Please run: sudo apt-get install ${missing[*]}" >&2
  exit 0  # what really needs one of them says so itself
fi
echo "Installing Debian packages: ${missing[*]}"
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
