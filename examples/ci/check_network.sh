#!/usr/bin/env bash
# Holds a network against a regression suite, as a CI job does; both workflows in this folder call it.
#   check_network.sh NETWORK SUITE.json RESULTS
# NETWORK: as `ds drive --driver` takes it. RESULTS: folder for junit.xml, summary.md and the page.
# DS: the command, "ds" if not set. Exit status: that of `ds suite run`; 3 is a test that newly fails.
set -euo pipefail
network=$1 suite=$2 results=$3
mkdir -p "$results"
status=0
${DS:-ds} suite run "$suite" --driver "$network" --out "$results/suite" \
  --fail-on regression --junit "$results/junit.xml" --markdown "$results/summary.md" || status=$?
# The job's own page shows the summary, also where the check fails; 1 and 2 leave none.
if [[ -n ${GITHUB_STEP_SUMMARY:-} && -f $results/summary.md ]]; then
  cat "$results/summary.md" >>"$GITHUB_STEP_SUMMARY"
fi
exit "$status"
