"""The command `cg`: what it lists, what it passes on, what it says to a slip of the finger."""

import pytest

from cg_sysid.cli.command import COMMANDS, LAUNCHER, main


def test_help_lists_every_command_in_one_line_each(capsys):
    for words in ([], ['-h'], ['--help'], ['help']):
        assert main(words) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == 'usage: cg COMMAND [ARGS...]'
        for name, command in COMMANDS.items():
            mine = [line for line in lines if line.split()[:1] == [name]]
            assert mine == [line for line in lines if command.summary in line]
            assert len(mine) == 1
            assert len(mine[0]) < 100


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_helps(name, capsys):
    with pytest.raises(SystemExit) as left:
        main([name, '--help'])
    assert left.value.code == 0
    assert capsys.readouterr().out.startswith(f'usage: cg {name}')


def test_names_of_executables_do_as_well(capsys):
    with pytest.raises(SystemExit):
        main(['frequency_response', '--help'])
    assert capsys.readouterr().out.startswith('usage: cg frequency-response')


@pytest.mark.parametrize(
    ('typed', 'meant'), [('diagnos', 'diagnose'), ('chek', 'check'), ('freq-response', None)]
)
def test_an_unknown_command_names_the_nearest(typed, meant, capsys):
    assert main([typed]) == 2
    assert capsys.readouterr().err == (
        f'cg: error: there is no command {typed!r}; did you mean '
        f"'{meant or 'frequency-response'}'?\n"
    )


def test_the_launcher_has_commands_of_its_own(monkeypatch, capsys):
    assert main(['lanch']) == 2
    assert 'launch' not in capsys.readouterr().err
    monkeypatch.setenv(LAUNCHER, 'list run launch exec')
    assert main(['lanch']) == 2
    assert capsys.readouterr().err.endswith("did you mean 'launch'?\n")


def test_what_is_near_to_nothing_gets_the_list(capsys):
    assert main(['xyzzy']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert all(name in said for name in COMMANDS)


def test_exit_codes_pass_through(tmp_path, capsys):
    assert main(['report', str(tmp_path / 'none')]) == 2
    assert capsys.readouterr().err.startswith('cg report: error: ')
