"""A model is meant by its path or, if it comes along, by its name."""

import pytest

from cg_description.model_file import ModelFileError
from cg_description.paths import model_names, model_path, models_directory


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path))
    return tmp_path


@pytest.mark.parametrize('name', model_names())
def test_a_name_means_the_file_that_comes_along(name, elsewhere):
    assert model_path(name) == models_directory() / f'{name}.yaml'


def test_a_path_means_that_file(elsewhere):
    (elsewhere / 'mine.yaml').write_text('')
    assert model_path('mine.yaml').resolve() == elsewhere / 'mine.yaml'
    assert model_path(elsewhere / 'mine.yaml') == elsewhere / 'mine.yaml'
    assert model_path('~/mine.yaml') == elsewhere / 'mine.yaml'


def test_a_file_comes_before_a_name_and_a_directory_does_not(elsewhere):
    (elsewhere / 'compass_gait_mit').mkdir()
    assert model_path('compass_gait_mit').parent == models_directory()
    (elsewhere / 'sydney_pendulum').write_text('')
    assert model_path('sydney_pendulum').resolve() == elsewhere / 'sydney_pendulum'


@pytest.mark.parametrize(
    'name', ['compass_gait', 'mine.yaml', '', '.', '../models/compass_gait_mit']
)
def test_what_is_neither_is_refused_with_what_was_tried(name, elsewhere):
    with pytest.raises(ModelFileError) as refused:
        model_path(name)
    said = str(refused.value)
    assert said.startswith(f'no model {name!r}: there is no file {elsewhere}')
    assert all(known in said for known in model_names())
