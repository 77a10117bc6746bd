"""The experiments as data: each loads, moves the machine well and stays within its limits."""

import numpy as np
import pytest
import yaml

from cg_bringup.runs import Run, experiment_nodes, parameter_file_text
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_sysid.experiments.catalogue import (
    ExperimentError,
    experiment_names,
    load_experiment,
    parse_experiment,
)
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal

EXPECTED = {
    'spring_stabilised_inner', 'spring_stabilised_outer', 'swing_inner_fixed',
    'swing_outer_fixed', 'legs_tied', 'spring_calibration', 'chirp', 'open_loop_playback',
}  # fmt: skip
SAMPLE = 0.002  # s


def simulate(experiment, seed):
    model = Model.load(model_path('compass_gait_mit'))
    plant = Plant(model, experiment.setup, np.array(experiment.initial_state), SAMPLE, seed)
    signal = make_signal(
        ExcitationSettings(**experiment.excitation, duration=experiment.duration, seed=seed)
    )
    states, torques = [], []
    for k in range(round(experiment.duration / SAMPLE)):
        torques.append(signal(k * SAMPLE))
        states.append(plant.state)
        plant.latch(np.array([torques[-1]]))
        plant.advance()
    return model, np.array(states), np.array(torques)


def test_every_promised_experiment_is_there():
    assert EXPECTED <= set(experiment_names())


@pytest.mark.parametrize('name', sorted(EXPECTED - {'chirp'}))
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_the_machine_moves_well_and_within_its_limits(name, seed):
    experiment = load_experiment(name)
    model, states, torques = simulate(experiment, seed)
    angles = states[:, : states.shape[1] // 2]
    assert np.all(np.std(angles, axis=0) > 0.04)  # rad; a thousand times the sensor noise
    assert np.abs(angles).max() < 1.9  # rad
    assert np.abs(torques).max() <= 0.6 * model.torque_limit
    springs = experiment.setup.springs
    if springs:
        # A spring must stay in tension: it is linear only there.
        stance = angles[:, 0] if experiment.setup.stance == 'inner' else angles[:, -1]
        for spring in springs:
            end = spring.point * np.stack([np.sin(stance), np.cos(stance)], axis=1)
            lengths = np.linalg.norm(end - np.array(spring.anchor), axis=1)
            assert lengths.min() > spring.free_length


def test_seeds_make_different_records_of_one_experiment():
    experiment = load_experiment('spring_stabilised_inner')
    first, second = (simulate(experiment, seed)[1] for seed in (1, 2))
    assert np.std(first[:, 1] - second[:, 1]) > 0.1


def test_unknown_experiment_lists_those_there_are():
    with pytest.raises(ExperimentError, match='legs_tied'):
        load_experiment('no_such')


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'setup': {'stance': 'left'}}, 'stance'),
        ({'excitation': {'kind': 'square'}}, 'kind'),
        ({'excitation': {'kind': 'chirp', 'color': 1}}, 'color'),
        ({'surprise': 1}, "unknown entry 'surprise'; allowed: setup, initial_state"),
    ],
)
def test_a_wrong_file_is_refused_with_its_reason(tmp_path, change, message):
    entries = {
        'setup': {}, 'initial_state': [], 'duration': 1.0, 'excitation': {'kind': 'none'}, **change
    }  # fmt: skip
    with pytest.raises(ExperimentError, match=message):
        parse_experiment(tmp_path / 'e.yaml', entries)


def test_parameters_reach_the_nodes_as_they_are_declared():
    run = Run(load_experiment('chirp'), bag='/tmp/b', seed=7, duration=3.0)
    tree = yaml.safe_load(parameter_file_text(experiment_nodes(run)))
    machine = tree['simulation_node']['ros__parameters']
    assert machine['seed'] == tree['excitation']['ros__parameters']['seed'] == 7
    assert machine['duration'] == 3.0
    assert tree['recorder']['ros__parameters']['time'] == 'stamp'


def test_wrong_mode_is_refused():
    with pytest.raises(ExperimentError, match='lockstep, real_time'):
        Run(load_experiment('chirp'), bag='/tmp/b', mode='slow')
