"""Fixtures of the diagnosis tests."""

import pytest
from demos import demo
from study import deployment

from magbridge.diagnose.descriptions import Description, descriptions
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.joint import fit_joint
from magbridge.diagnose.problem import Problem, pose
from magbridge.diagnose.run import diagnose
from magbridge.diagnose.survey import load_survey


@pytest.fixture(scope="session")
def problem() -> Problem:
    """Return the problem of the demo's survey with the calibration from the demo's own calibration runs."""
    return pose(load_survey([demo().survey], demo().calibration), demo().calibration)


@pytest.fixture(scope="session")
def listed(problem: Problem) -> list[Description]:
    """Return the descriptions of the demo's residuals that name no cause, for a fit of noise only."""
    return descriptions(problem, fit_joint(problem, [], 1))


@pytest.fixture(scope="session")
def clear() -> Diagnosis:
    """Return a diagnosis that identifies a current's field unambiguously, from 2 h of the study's vehicle."""
    hours, deployment.HOURS = deployment.HOURS, 2.0
    deployment.vehicle.cache_clear()
    here = deployment.Background.of(deployment.vehicle(0), 24, "white")
    log = here.log(here.hide("current_field", 60.0, 24).ds)
    found = diagnose([log], here.deployment.calibration).diagnosis
    deployment.HOURS = hours
    deployment.vehicle.cache_clear()
    return found
