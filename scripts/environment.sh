# Sourced by the other scripts: makes .venv, or brings it up to date.
#   make_environment [EXTRAS]     e.g. make_environment dev,train
make_environment() {
  local extras="${1:-}" python="${PYTHON:-python3}" stamp wanted
  if [[ ! -x .venv/bin/python ]]; then
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
      echo "$python is older than Python 3.11; set PYTHON to a newer one" >&2
      exit 1
    }
    "$python" -m venv .venv
  fi
  # One stamp per set of extras: an unchanged pyproject.toml needs no second installation.
  stamp=".venv/installed-${extras:-base}"
  wanted="$(cksum < pyproject.toml)"
  if [[ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]]; then
    echo "Installing into .venv ..."
    .venv/bin/python -m pip install --quiet --disable-pip-version-check \
      --editable ".${extras:+[$extras]}"
    echo "$wanted" > "$stamp"
  fi
}
