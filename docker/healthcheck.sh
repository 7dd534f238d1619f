#!/bin/sh
# Is the service that this container runs alive? Asks the bus for its health report. Which service it is stands on the command
# line of process 1, after "serve"; the configuration is the one given there and in the environment. HEALTHCHECK_ENDPOINT is for the
# router, which listens on addresses that cannot be connected to by name.
set -eu

words() { tr '\0' '\n' <"${HEALTHCHECK_COMMAND_LINE:-/proc/1/cmdline}"; }

service=$(words | awk 'previous == "serve" { print; exit } { previous = $0 }')
config=$(words | awk 'previous == "--config" { print; exit } sub(/^--config=/, "") { print; exit } { previous = $0 }')

# Any other command (run, evaluate) has no report; it is healthy as long as it runs.
[ -n "$service" ] || exit 0
if [ -n "${HEALTHCHECK_ENDPOINT:-}" ]; then export VGGT_MOTION_BUS__ENDPOINT="$HEALTHCHECK_ENDPOINT"; fi
if [ -n "$config" ]; then set -- --config "$config"; else set --; fi
# Well within the timeout of the image's HEALTHCHECK.
exec vggt-motion health "$service" "$@" --set bus.connect_timeout_s=3 --timeout-s 4
