"""Two holders never get the same ROS domain."""

import os

import pytest

from cg_interfaces.domains import DOMAINS, own_domain


def test_nested_holders_differ_and_the_environment_comes_back(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    with own_domain() as first:
        assert os.environ['ROS_DOMAIN_ID'] == str(first)
        with own_domain() as second:
            assert first != second
        assert os.environ['ROS_DOMAIN_ID'] == str(first)
    assert os.environ['ROS_DOMAIN_ID'] == '7'


def test_the_domain_that_has_rested_longest_is_next(tmp_path, monkeypatch):
    """Whoever held it, as nodes that were killed there may still be heard."""
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    for domain in DOMAINS:
        file = tmp_path / f'ros_domain_{domain}.lock'
        file.touch()
        os.utime(file, (0, 1e9 - (domain * 37) % 101))
    order = sorted(DOMAINS, key=lambda domain: -((domain * 37) % 101))
    for expected in (*order, *order[:3]):
        with own_domain() as domain:
            assert domain == expected


def test_an_error_inside_is_that_error():
    with pytest.raises(FileNotFoundError), own_domain():
        raise FileNotFoundError
