#!/usr/bin/env bash
# Cells of the studies on LIBERO, several at a time: one process and WORKERS simulators on each GPU. Cells are taken from
# one list, the most wanted first; one that was cut short goes on when the script is run again with the same W.
#   W=DIR        where episodes are kept: $W/episodes/CELL (default $OUT, else work/cells)
#   IN=DIR       an earlier W whose episodes are taken over first (into a new machine)
#   GPUS="0 1"   (default 0 1 2 3)    WORKERS=N  for each GPU (default 16)    LIMIT=S  seconds until all is ended (560)
#   ONLY=REGEX   of "STUDY|CELL" lines below, such as ONLY='^steps_libero'
# The report, on any machine, without a GPU or the simulator:
#   python3 -m turbopi study steps_libero,kv_reuse_libero,fp8_and_fp4_libero,mask_libero --device cpu --report-only --out $W
set -uo pipefail
cd "$(dirname "$0")"
export PYTHONPATH=${PYTHONPATH:-src:tools:tests} OMP_NUM_THREADS=${OMP_NUM_THREADS:-4}
W=${W:-${OUT:-work/cells}} GPUS=${GPUS:-0 1 2 3} WORKERS=${WORKERS:-16} LIMIT=${LIMIT:-560} PYTHON=${PYTHON:-python3}
DEVICE=${DEVICE:-cuda} # cpu, EXTRA='--simulator chase --episodes 4 CHECKPOINT': to try this script
end=$(($(date +%s) + LIMIT))
mkdir -p "$W/episodes" "$W/logs"
if [ -n "${IN:-}" ]; then cp -rn "$IN/episodes/." "$W/episodes/"; fi

cells() {
  cat <<'LIST'
steps_libero|plain
steps_libero|euler, uniform, 1
steps_libero|euler, uniform, 2
steps_libero|euler, uniform, 3
steps_libero|exponential, uniform, 2
steps_libero|ab2, uniform, 2
steps_libero|exponential, uniform, 3
mask_libero|padded, not masked
kv_reuse_libero|every 2
fp8_and_fp4_libero|NVFP4
kv_reuse_libero|full 0.9
fp8_and_fp4_libero|W4A8
kv_reuse_libero|patch 0.9
fp8_and_fp4_libero|NVFP4, scales ignored
kv_reuse_libero|patch 0.985
fp8_and_fp4_libero|FP8
steps_libero|control
mask_libero|control
kv_reuse_libero|control
fp8_and_fp4_libero|control
kv_reuse_libero|full 0.92
kv_reuse_libero|every 2, of another episode
kv_reuse_libero|patch 0.95
fp8_and_fp4_libero|W4A8 (MXFP4)
fp8_and_fp4_libero|NVFP4, weights alone
kv_reuse_libero|full 0.985
kv_reuse_libero|full 0.87
mask_libero|padded, masked
LIST
}

queue=$(mktemp)
cells | grep -E "${ONLY:-.}" >"$queue"

next() { # takes the list's first line
  flock "$queue.lock" bash -c 'head -n 1 "$1"; sed -i 1d "$1"' _ "$queue"
}

on_gpu() {
  local line study cell left name rc
  while line=$(next) && [ -n "$line" ]; do
    study=${line%%|*} cell=${line#*|} left=$((end - $(date +%s)))
    if [ "$left" -lt 20 ]; then return; fi
    name=$(tr -c 'A-Za-z0-9.\n' '_' <<<"$study $cell")
    local started=$SECONDS
    CUDA_VISIBLE_DEVICES=$1 MUJOCO_EGL_DEVICE_ID=$1 timeout -k 5 "$left" "$PYTHON" -m turbopi study "$study" \
      --device "$DEVICE" --workers "$WORKERS" --out "$W" --way "$cell" --episodes-only ${EXTRA:-} >"$W/logs/$name.log" 2>&1
    rc=$?
    echo "GPU $1, $((SECONDS - started)) s, rc $rc: $study: $cell: $(tail -n 1 "$W/logs/$name.log")"
  done
}

for gpu in $GPUS; do on_gpu "$gpu" & done
wait
rm -f "$queue" "$queue.lock"
