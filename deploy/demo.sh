#!/bin/sh
# A flight over a simulated sports ground, mapped while it lasts: ground station and aircraft on this machine.
# Usage: deploy/demo.sh [SOURCE]     stops both with Ctrl-C. PYTHON names the interpreter that Luojia is installed in.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
python=${PYTHON:-$root/.venv/bin/python}
source=${1:-sim:playground?seed=1&duration=300&camera.rate_hz=5&base=off}
viewer_port=8080
bus_port=7447

if [ ! -x "$python" ]; then
    echo "demo: $python is missing; run 'make install' first, or set PYTHON" >&2
    exit 1
fi
for port in $viewer_port $bus_port; do
    "$python" - "$port" <<'PY' || exit 1
import socket, sys
port = int(sys.argv[1])
with socket.socket() as probe:
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        probe.bind(("127.0.0.1", port))
    except OSError as error:
        sys.exit(f"demo: port {port} is taken by another program ({error.strerror}); stop that one and try again")
PY
done

work=$(mktemp -d "${TMPDIR:-/tmp}/luojia-demo.XXXXXX")
ground= air=
stop() {
    trap '' INT TERM
    for process in $air $ground; do
        kill -TERM "$process" 2>/dev/null || true
    done
    wait
    rm -rf "$work"
}
trap stop EXIT
trap 'exit 0' INT TERM

cat >"$work/ground.toml" <<TOML
[bus]
listen = ["tcp/127.0.0.1:$bus_port"]
[store]
path = "$work/ground.sqlite"
[viewer]
port = $viewer_port
TOML
cat >"$work/air.toml" <<TOML
[bus]
connect = ["tcp/127.0.0.1:$bus_port"]
TOML

cd "$root"
# In sessions of their own, so that Ctrl-C reaches them only through this script: first the aircraft, then the ground.
setsid "$python" -m ground serve --config "$work/ground.toml" &
ground=$!
setsid "$python" -m air run --config "$work/air.toml" --source "$source" &
air=$!
echo "demo: open http://127.0.0.1:$viewer_port in a browser; the first tiles come within a minute; Ctrl-C ends it"

while kill -0 "$ground" 2>/dev/null && kill -0 "$air" 2>/dev/null; do
    sleep 1 &
    wait $!
done
echo "demo: one of the two processes ended by itself; what it said is above" >&2
exit 1
