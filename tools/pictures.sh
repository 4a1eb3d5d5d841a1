#!/usr/bin/env bash
# The pictures of the README, in docs/pictures: a strip of rollouts and the report. Needs `make programs`, robosuite's Python
# (.venv) and Chromium.
set -euo pipefail
cd "$(dirname "$0")/.."
browser=${ACTRM_CHROMIUM:-$(command -v chromium || command -v chromium-browser || command -v google-chrome)}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p docs/pictures

shot() { # shot PAGE WIDTH HEIGHT FILE
    "$browser" --headless=new --no-sandbox --disable-gpu --hide-scrollbars --user-data-dir="$work/profile" \
        --autoplay-policy=no-user-gesture-required --virtual-time-budget=20000 --window-size="$2,$3" \
        --screenshot="$4" "file://$1" 2>/dev/null
}

# a row an entry, five moments of its first test episode
mkdir -p "$work/zoo"
page=$work/rollouts.html
echo '<body style="margin:0;font:600 13px system-ui;display:grid;grid-template-columns:repeat(5,160px)">' >"$page"
for entry in stack-act door-act-s1 stackcolor-actrm-s1 nutassemblysquare-actrm-s1; do
    cp -r "zoo/$entry" "$work/zoo/"
    target/release/actrm-zoo eval "$entry" --episodes 1 --seed-start 40000 --video 1 --video-size 160 -j 1 --zoo "$work/zoo" >/dev/null
    film=$(ls "$work"/zoo/videos/"$entry"@*/*.mp4)
    for moment in 0.02 0.25 0.5 0.75 0.98; do
        echo "<video muted width=160 height=160 data-at=$moment src=\"data:video/mp4;base64,$(base64 -w0 "$film")\"></video>" >>"$page"
    done
done
echo '<script>document.querySelectorAll("video").forEach((v) => {
  const seek = () => { v.currentTime = v.dataset.at * v.duration; };
  if (v.readyState > 0) seek(); else v.onloadedmetadata = seek;
});</script>' >>"$page"
shot "$page" 800 640 docs/pictures/rollouts.png

target/release/actrm-zoo leaderboard --out "$work/report" >/dev/null
shot "$work/report/report.html" 1280 900 docs/pictures/report.png
