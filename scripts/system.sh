#!/usr/bin/env bash
# The system libraries that images need: GL (EGL, OSMesa) for LIBERO's, Vulkan for SIMPLER's. Physics needs none.
# Usage: scripts/system.sh install | dry | check | release
#   install  install what is missing, where this is root on Debian or Ubuntu; else print the commands
#   dry      print the commands
#   check    say in two lines what is missing, if anything is; always succeeds
#   release  install what the release itself has of it, where this is root, then check: what comes with `make eval` and
#            `make test`; a newer Mesa out of backports replaces a dozen packages, so it is left to `make system`
# Environment: APT_SOURCES, folder for a new apt source; OS_RELEASE, a file; VULKAN_ICDS, folders with drivers.
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin
mode=${1:-dry}
sources=${APT_SOURCES:-/etc/apt/sources.list.d}
# SAPIEN finds no device in Mesa's software driver before this version.
needed=24.3

present() { [[ $(ldconfig -p 2>/dev/null) == *"$1"* ]]; }
older() { [[ $(printf '%s\n' "${1#*:}" "$needed" | sort -V | head -n 1) != "$needed" ]]; }
installed() { dpkg-query -W -f '${Version}' "$1" 2>/dev/null || true; }
candidate() { LC_ALL=C apt-cache policy "$1" 2>/dev/null | awk '$1 == "Candidate:" && $2 != "(none)" {print $2}'; }
codename() { (. "${OS_RELEASE:-/etc/os-release}" && echo "${VERSION_CODENAME:-}") 2>/dev/null || true; }

gpu_driver() {
  local folder
  for folder in $(tr ':' ' ' <<<"${VULKAN_ICDS:-/usr/share/vulkan/icd.d:/etc/vulkan/icd.d}"); do
    compgen -G "$folder/nvidia*.json" >/dev/null && return
  done
  return 1
}

plain=() mesa=""
present libEGL.so.1 || plain+=(libegl1 libgl1-mesa-dri)
present libOSMesa.so || plain+=(libosmesa6)
present libvulkan.so.1 || plain+=(libvulkan1)
if ! gpu_driver; then
  have=$(installed mesa-vulkan-drivers)
  if [[ -z $have ]] || older "$have"; then mesa=mesa-vulkan-drivers; fi
fi
[[ ${#plain[@]} -gt 0 || -n $mesa ]] || { [[ $mode == check ]] || echo "==> GL and Vulkan are there"; exit 0; }

apt="env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends"
if [[ $mode == release ]]; then
  if [[ ${#plain[@]} -gt 0 && $(id -u) -eq 0 ]] && command -v apt-get >/dev/null; then
    apt-get update >/dev/null || echo "==> apt-get update failed; going on"
    lacking=()
    for package in "${plain[@]}"; do
      [[ -n $(candidate "$package") ]] || continue
      echo "==> $apt $package"
      $apt "$package" >/dev/null || lacking+=("$package")
    done
    plain=(${lacking[@]+"${lacking[@]}"})
    [[ ${#plain[@]} -gt 0 || -n $mesa ]] || exit 0
  fi
  mode=check
fi

missing="${plain[*]:-}${mesa:+ $mesa (Mesa $needed or newer)}"
if [[ $mode == check ]]; then
  echo "==> missing system libraries for images: ${missing# }"
  echo "    physics runs without; 'make system' installs them, 'make doctor' says what works"
  exit 0
fi

if ! command -v apt-get >/dev/null; then
  echo "==> this is not Debian or Ubuntu; install the equivalents of: ${missing# }" >&2
  exit 1
fi

# Commands to run, one a line of words.
commands=("apt-get update")
wanted=()
for package in "${plain[@]}"; do  # recent distributions have no OSMesa any more; EGL does the same
  if [[ $package != libosmesa6 || -n $(candidate libosmesa6) ]]; then wanted+=("$package"); fi
done
note=""
if [[ -n $mesa ]]; then
  offered=$(candidate "$mesa")
  if [[ -n $offered ]] && ! older "$offered"; then
    wanted+=("$mesa")
  elif [[ $(codename) == bookworm ]]; then
    if [[ $(LC_ALL=C apt-cache policy 2>/dev/null) != *bookworm-backports* ]]; then
      # From the same mirror as the release itself.
      mirror=$(LC_ALL=C apt-cache policy | awk '$3 == "bookworm/main" {print $2; exit}')
      line="deb ${mirror:-http://deb.debian.org/debian} bookworm-backports main"
      commands=("add $sources/bookworm-backports.list $line" "${commands[@]}")
    fi
    wanted_backports=$mesa
  else
    note="the newest $mesa here is ${offered:-none}: SIMPLER's images need $needed, so a GPU's driver or a newer release"
  fi
fi
[[ ${#wanted[@]} -eq 0 ]] || commands+=("$apt ${wanted[*]}")
[[ -z ${wanted_backports:-} ]] || commands+=("$apt -t bookworm-backports $wanted_backports")

say() { if [[ $1 == add ]]; then echo "echo '${*:3}' > $2"; else echo "$*"; fi; }
add() { echo "${*:2}" >"$1"; }

if [[ $mode == install && $(id -u) -eq 0 ]]; then
  for command in "${commands[@]}"; do
    # shellcheck disable=SC2086
    echo "==> $(say $command)"
    # shellcheck disable=SC2086
    $command
  done
  [[ -z $note ]] || echo "==> $note"
  exit 0
fi
[[ $mode == dry ]] || echo "==> only root can install system libraries; as root:" >&2
for command in "${commands[@]}"; do
  # shellcheck disable=SC2086
  say $command
done
[[ -z $note ]] || echo "# $note"
[[ $mode == dry ]] || exit 1
