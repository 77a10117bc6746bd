"""Two holders never get the same ROS domain."""

import os

from cg_dynamics.domains import own_domain


def test_nested_holders_differ_and_the_environment_comes_back(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    with own_domain() as first:
        assert os.environ['ROS_DOMAIN_ID'] == str(first)
        with own_domain() as second:
            assert first != second
        assert os.environ['ROS_DOMAIN_ID'] == str(first)
    assert os.environ['ROS_DOMAIN_ID'] == '7'
