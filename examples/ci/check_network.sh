#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Holds a network against tests, as a CI job does; both workflows in this folder and the action at the root call it.
#   check_network.sh NETWORK TESTS RESULTS [OPTION...]
# NETWORK: as `ds drive --driver` takes it. TESTS: a suite, .json, or the configuration of a campaign, .yaml, whose
# driver NETWORK replaces. RESULTS: folder for junit.xml, summary.md, videos of failures and everything else.
# OPTIONS: of `ds suite run` or `ds campaign run`; --fail-on is regression or failure if left out.
# DS: the command, "ds" if not set. Exit status: that of the verb; 3 is a criterion that is not met.
set -euo pipefail
network=$1 tests=$2 results=$3
shift 3
mkdir -p "$results"
status=0
if [[ $tests == *.json ]]; then
  [[ " $* " == *" --fail-on "* ]] || set -- --fail-on regression "$@"
  ${DS:-ds} suite run "$tests" --driver "$network" --out "$results/suite" "$@" --videos "$results/videos" \
    --junit "$results/junit.xml" --markdown "$results/summary.md" || status=$?
else
  [[ " $* " == *" --fail-on "* ]] || set -- --fail-on failure "$@"
  ${DS:-ds} campaign run "$tests" --driver "$network" --out "$results/campaign" "$@" --videos "$results/videos" \
    --junit "$results/junit.xml" >"$results/answer.txt" || status=$?
  cat "$results/answer.txt"
  { echo '```text'; cat "$results/answer.txt"; echo '```'; } >"$results/summary.md"
fi
# The job's own page shows the summary, also where the check fails; 1 and 2 leave none of a suite.
if [[ -n ${GITHUB_STEP_SUMMARY:-} && -f $results/summary.md ]]; then
  cat "$results/summary.md" >>"$GITHUB_STEP_SUMMARY"
fi
exit "$status"
