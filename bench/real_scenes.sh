#!/usr/bin/env bash
# Fit each of five real scene formats with no flag but split, out, downscale and steps; print a line per scene.
# usage: bench/real_scenes.sh DATA OUT [STEPS]     (DATA holds llff/fern, llff/horns, colmap/fern, fox, templeSparseRing)
# templeSparseRing holds one photograph twice (1 and 11): every:5 holds both out, every:8 would train on a held-out picture.
set -euo pipefail
data=$1 out=$2 steps=${3:-1000}
mkdir -p "$out"
for row in "llff/fern every:8 2" "llff/horns every:8 2" "colmap/fern every:8 2" "fox every:8 8" "templeSparseRing every:5 2"; do
  read -r scene split downscale <<<"$row"
  warpgs fit "$data/$scene" --split "$split" --downscale "$downscale" --steps "$steps" --out "$out/${scene//\//-}" >"$out/${scene//\//-}.log" 2>&1 ||
    { echo "$scene: FAILED"; tail -3 "$out/${scene//\//-}.log"; continue; }
  python - "$scene" "$out/${scene//\//-}/metrics.json" <<'PY'
import json, sys
m = json.load(open(sys.argv[2]))
best = max(m["guesses"].values())
print(f"{sys.argv[1]}: held-out PSNR {m['test']['psnr']:.2f} dB ({m['views'][0]['region']}), best guess {best:.2f} dB, "
      f"gain {m['test']['psnr'] - best:.2f} dB, {m['gaussians']:,} Gaussians, {m['seconds']['total']:.0f} s")
PY
done
