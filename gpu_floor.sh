#!/usr/bin/env bash
# Whole calls in variants, in turns, and the timeline of one call: turns.txt and timeline.txt under $OUT.
set -euo pipefail
export PYTHONPATH=src:tools:tests
python3 -m call_turns --precisions "${PRECISIONS:-bf16,fp8}" --calls "${CALLS:-300}" --out "$OUT"
