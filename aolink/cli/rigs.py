"""Commands about rigs and their devices: rig, sim, devices."""

import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from aolink.cli import common
from aolink.cli.common import JsonOption, app, load_checked, program, stdout
from aolink.cli.terminal import input_ended
from aolink.errors import AolinkError, RigError
from aolink.signals import StopRequest
from aolink.units import counted

if TYPE_CHECKING:
    from aolink.rig import Rig

RigArgument = Annotated[str, typer.Argument(help="A rig file, or the name of a rig that comes with aolink.")]


@app.command(epilog="Example: aolink rig section-vi > my.toml  |  aolink rig my.toml --check")
def rig(
    rig: RigArgument = "",
    check: Annotated[bool, typer.Option("--check", help="Check the rig file, print the findings, and end.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the rigs that come with aolink, and end.")] = False,
    exposure_scan: Annotated[
        bool, typer.Option("--exposure-scan", help="Print the error of o1 to expect at other exposure times, and end.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check a rig file, list the rigs that come along, or print one to begin with."""
    from aolink.rig import builtin_rigs, load_rig
    from aolink.rig.edit import with_value

    if listed:
        for name in builtin_rigs():
            stdout.print(f"{name:<18}{load_rig(name).summary.split('. ')[0].rstrip('.')}.", markup=False)
        return
    if not rig:
        raise typer.BadParameter("name a rig file, or a rig that comes with aolink")
    if check:
        _print_findings(load_rig(rig), as_json)
        return
    if exposure_scan:
        _print_scan(load_rig(rig), as_json)
        return
    loaded = load_rig(rig)
    copied = f"copy of {loaded.name}" if rig in builtin_rigs() else loaded.name  # changed, it is another rig
    print(with_value(loaded.toml, "name", copied), end="")


def _print_scan(loaded: "Rig", as_json: bool) -> None:
    from aolink.cli.tables.rigs import exposure_scan as scan_table
    from aolink.estimation.exposure_scan import best, exposure_scan

    errors = exposure_scan(loaded)
    if as_json:
        print(json.dumps([vars(each) for each in errors]))
        return
    stdout.print(scan_table(loaded, errors))
    steps = best(errors).exposure_steps
    stdout.print(f"least error of the path: timing.exposure_steps = {steps}, {steps * loaded.timing.fast_step_s:g} s")


def _print_findings(loaded: "Rig", as_json: bool) -> None:
    from aolink.jobs.check_rig import check_devices, check_rig

    findings = [*check_devices(loaded), *check_rig(loaded)]
    if as_json:
        print(json.dumps([vars(finding) for finding in findings]))
    else:
        for finding in findings:
            stdout.print(f"{finding.severity:>7}  {escape(finding.key)}: {escape(finding.message)}")
        counts = Counter(finding.severity for finding in findings)
        found = ", ".join(counted(counts[kind], kind) for kind in ("error", "warning") if counts[kind])
        stdout.print(f"{loaded.name}: {found or 'the rig file is good'}")
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(RigError.exit_code)


@app.command(epilog="Example: aolink sim section-vi  |  aolink sim my.toml --real-time --fault bitflip=1e-6")
def sim(
    rig: RigArgument,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run in real time, not on virtual time.")] = False,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Instead of the rig file's seed.", min=0)] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve TCP ports, to this machine only, not terminals.")
    ] = None,
    light: Annotated[
        str | None,
        typer.Option(
            metavar="KIND,...",
            help="What the camera sees, start by start: dark, flat, flat:DENSITY, still, moving; the last stays.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="A fault of the line or the devices: bitflip=1e-6, stall=0.01, ..."),
    ] = None,
    tied: Annotated[bool, typer.Option("--tied", hidden=True)] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a simulated rig: print its two ports and serve them until stopped (Ctrl-C)."""
    from aolink.rig import load_rig, parse_light, with_faults

    loaded = load_rig(rig) if tied else load_checked(rig)  # whoever starts a tied one has said what is doubtful
    if light is not None:
        loaded = replace(loaded, simulation=replace(loaded.simulation, light=parse_light(light, "--light")))
    if fault:
        faults = with_faults(loaded.simulation.faults, fault)
        loaded = replace(loaded, simulation=replace(loaded.simulation, faults=faults))
    from aolink.simulation.server import RigServer
    from aolink.simulation.streams import open_streams

    with StopRequest().installed() as stop, ExitStack() as stack:
        links = None
        if loaded.simulation.faults.vanish_rate:
            links = Path(stack.enter_context(TemporaryDirectory(prefix="aolink-rig-")))
        streams = open_streams(listen, links=links)
        server = RigServer(loaded, streams, seed=seed, real_time=real_time)
        ports = {line: stream.name for line, stream in streams.items()}
        if as_json:
            print(json.dumps(ports), flush=True)
        else:
            for line, name in ports.items():
                print(f"{line}  {name}")
            print(
                f"rig {loaded.name}, {'real' if real_time else 'virtual'} time; to record 100 exposures from it:\n"
                f"  {program()} record --camera {ports['camera']} --mirror {ports['mirror']} --rig {rig}"
                " --estimator moments --exposures 100 -o session.mcap\nCtrl-C stops it.",
                flush=True,
            )
        server.run(lambda: stop() or (tied and input_ended()))
        for stream in streams.values():
            stream.close()
    stop.raise_if_asked()


@app.command(epilog="Example: aolink devices /dev/ttyACM0 socket://192.168.1.5:5000")
def devices(
    ports: Annotated[
        list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports whose devices to identify.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the serial ports and the drivers of this machine with their devices, or identify the devices behind
    ports."""
    from aolink.devices.discovery import FoundDevice, find_drivers, identify_port, list_ports

    if not ports:
        listed, drivers = list_ports(), find_drivers()
        if as_json:
            serial = [{"port": name, "description": text} for name, text in listed]
            print(json.dumps({"ports": serial, "drivers": [vars(each) for each in drivers]}))
            return
        for name, text in listed:
            stdout.print(f"{name}  {escape(text)}")
        if not listed:
            stdout.print("no serial ports on this machine; `aolink sim section-vi` makes a simulated pair")
        for each in drivers:
            stdout.print(f"{each.kind} driver {each.name}{': ' if each.problem else ''}{escape(each.problem)}")
            for lack in each.lacks:
                stdout.print(f"    {lack}", style="dim")
            if each.search:
                stdout.print(f"    {escape(each.search)}")
            for address, text in each.devices:
                stdout.print(f"    found: {escape(address)}  {escape(text)}")
        return
    found: list[FoundDevice] = []
    failed: AolinkError | None = None
    for port in ports:
        try:
            found.append(identify_port(port))
        except AolinkError as error:
            failed = error
            common.stderr.print(f"{port}: {escape(str(error))}")
            continue
        if not as_json:
            stdout.print(f"{port}: {escape(found[-1].text())}")
    if as_json:
        print(json.dumps([vars(each) for each in found]))
    if failed:
        raise typer.Exit(failed.exit_code)
