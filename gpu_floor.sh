#!/usr/bin/env bash
# Whole calls in variants, in turns, and the timeline of one call: turns.txt and timeline.txt under $OUT.
# gpu_floor.sh bf16, then gpu_floor.sh fp8; "gpu_floor.sh fp8 1" for one camera.
set -euo pipefail
export PYTHONPATH=src:tools:tests
python3 -m call_turns --precisions "${1:-bf16,fp8}" --cameras "${2:-2}" --calls "${CALLS:-300}" --out "$OUT"
