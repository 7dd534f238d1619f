"""``vggt-motion`` with other endpoints for some services: ``python linked_run.py '{"frontend": "tcp/..."}' run ...``.

The services named in the JSON object join the bus at the endpoint given there: a proxy of the test. Everything else is
the shipped command.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import yaml

from vggt_motion import cli, launch
from vggt_motion.supervise import ServiceCommand

_original = launch.service_commands
_endpoints: dict[str, str] = json.loads(sys.argv[1])


def _service_commands(request: launch.RunRequest, config_file: Path) -> list[ServiceCommand]:
    commands = []
    for command in _original(request, config_file):
        endpoint = _endpoints.get(command.name)
        if endpoint is not None:
            settings = yaml.safe_load(config_file.read_text(encoding="utf-8"))
            settings["bus"]["endpoint"] = endpoint
            other = config_file.with_name(f"config-{command.name}.yaml")
            other.write_text(yaml.safe_dump(settings), encoding="utf-8")
            arguments = tuple(
                str(other) if argument == str(config_file) else argument for argument in command.arguments
            )
            command = ServiceCommand(command.name, command.label, arguments, command.tier, command.ends_by_itself)
        commands.append(command)
    return commands


launch.service_commands = _service_commands
sys.argv = ["vggt-motion", *sys.argv[2:]]
cli.main()
