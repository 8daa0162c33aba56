#!/usr/bin/env bash
# A real lenslet photograph with a real flight's poses, through the daemon's own pipeline, published over ZeroMQ.
#   examples/replay-letters.sh ../shared/data [subscriber's folder]
# The frames: plenoptomos' "letters", 1280 × 960, with white and dark frame. The flight: a copter, 1377 s of telemetry.
set -euo pipefail
data=${1:?give the folder of test data, such as ../shared/data}
received=${2:-received}
here=$(cd "$(dirname "$0")/.." && pwd)
dappled=$here/.venv/bin/dappled
sockets=$(mktemp -d /tmp/dappled-letters.XXXXXX)
trap 'rm -rf "$sockets"' EXIT
printf '[publish]\nslices = "ipc://%s/slices"\n' "$sockets" > "$sockets/dappled.toml"

"$dappled" watch "ipc://$sockets/slices" --save "$received" --count 1 --timeout 60 &
letters=$data/lenslet/ulf_letters
"$dappled" replay "$letters" --match letters_ULF_M1.png --mask lenslet \
  --white "$letters/letters_ULF_M1_white.png" --dark "$letters/letters_ULF_M1_dark.png" \
  --telemetry "$data/telemetry/dronekit-flight.tlog" --publish --config "$sockets/dappled.toml"
wait $!
