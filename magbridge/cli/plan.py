"""Plan what to calibrate with: spirals, or a survey that calibrates itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    AS_THEY_SAY,
    Heading,
    Json,
    ReadingOptions,
    Whole,
    command,
    complain,
    logs_to_read,
    print_result,
)
from magbridge.cli.remarks import naming, note_losses
from magbridge.errors import WrongUse
from magbridge.progress import waiting


@command("plan --mission FILE [--calibration cal.json] [--survey HOURS] [OPTIONS]")
def plan(
    *,
    mission: Path,
    calibration: Path | None = None,
    runs: Annotated[Whole, Parameter(validator=validators.Number(gte=1, lte=100))] = 10,
    survey: Annotated[float | None, Parameter(validator=validators.Number(gte=0.5, lte=1000))] = None,
    parameter: tuple[str, ...] = (),
    roll: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=90))] = 10.0,
    heading_reference: Heading = None,
    reading: ReadingOptions = AS_THEY_SAY,
    json: Json = False,
) -> None:
    """Choose the calibration runs to fly next: those that make the mission's worst error smallest.

    With --survey: the patterns of a survey that calibrates itself, without runs and without a map, with the
    expected accuracy of each.

    Parameters
    ----------
    mission
        A log, real or simulated, that flies as the mission will: attitude, position, moving masses.
    calibration
        The calibration so far (cal.json). A survey can be planned without one.
    runs
        Number of spirals.
    survey
        Hours that a survey may take.
    parameter
        With --survey and no calibration: a column that gives a moving mass's position; may be repeated.
    roll
        Largest bank angle in deg that the vehicle can fly, either way.
    """
    from magbridge.calibration.file import load
    from magbridge.calibration.planning import plan as flights
    from magbridge.calibration.planning import survey_patterns
    from magbridge.field.reference import with_true_heading
    from magbridge.logs import read

    if calibration is None and survey is None:
        raise WrongUse("expected --calibration, or --survey HOURS to plan a survey without one")
    logs_to_read((mission,), None, calibration)
    with waiting("reading"):
        deployment = with_true_heading(read(mission, options=reading.options), heading_reference)
    note_losses(deployment.attrs)
    known = load(calibration) if calibration else None
    with naming(deployment), waiting("planning"):
        if survey is None:
            assert known is not None
            found = flights.flight_plan(known, deployment, runs=runs, roll=roll)
            result = flights.facts(found, known), flights.summary(found, known)
        else:
            proposed = survey_patterns.survey_plan(known, deployment, parameter, hours=survey, roll=roll)
            for line in proposed[0].open:
                complain(line)
            result = survey_patterns.facts(proposed), survey_patterns.summary(proposed)
    print_result(*result, json)
