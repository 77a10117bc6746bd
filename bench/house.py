"""What the packages are like to live in: rooms, lengths, constants, depth of imports.

    ./cg exec python bench/house.py [CHECKOUT ...] [--write FILE]

One column for each checkout, this one last. Read from the sources, nothing is imported.

    modules, rooms       .py files of the packages; folders that hold them
    fullest room         most modules in one folder
    longest file         lines of it
    longest function     lines of a function or method, docstring included
    most methods         of one class
    constants            numbers by a capital name in a module, or fields of the settings
    said more than once  names of such constants that several modules define
    import floors        longest chain of imports among the modules of cg_sysid
"""

import argparse
import ast
import subprocess
from collections import Counter
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


def sources(checkout: Path) -> dict[str, tuple[Path, ast.Module, int]]:
    """Module name -> file, tree, lines."""
    found = {}
    for file in sorted(checkout.glob('src/cg_*/cg_*/**/*.py')):
        parts = file.relative_to(checkout / 'src').with_suffix('').parts[1:]
        text = file.read_text('utf-8')
        found['.'.join(parts)] = file, ast.parse(text), text.count('\n')
    return found


def constants(tree: ast.Module) -> list[str]:
    """Names of the numbers that a module defines."""
    names = []
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, 'target', None)]
        value = getattr(node, 'value', None)
        for target in targets:
            if isinstance(target, ast.Name) and target.id.isupper() and _is_number(value):
                names.append(target.id)
    return names


def _is_number(node: ast.AST | None) -> bool:
    return node is not None and all(
        isinstance(n, ast.Constant | ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop)
        and not isinstance(getattr(n, 'value', 0), str | bytes | bool)
        for n in ast.walk(node)
    )


def thresholds(tree: ast.Module) -> int:
    """Numbers that are fields of frozen settings, in a module of thresholds."""
    return sum(
        isinstance(field, ast.AnnAssign) and field.value is not None
        for node in tree.body if isinstance(node, ast.ClassDef) for field in node.body
    )  # fmt: skip


def depth(modules: dict[str, tuple[Path, ast.Module, int]], package: str) -> int:
    """Modules in the longest chain of imports within a package."""
    own = {name: tree for name, (_, tree, _) in modules.items() if name.startswith(package)}

    def imported(tree: ast.Module) -> set[str]:
        names = set()
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
        return names & own.keys()

    @cache
    def floors(name: str) -> int:
        return 1 + max((floors(other) for other in imported(own[name]) - {name}), default=0)

    return max(map(floors, own))


def column(checkout: Path) -> dict[str, str]:
    """The rows of one checkout."""
    modules = sources(checkout)
    rooms = Counter(file.parent for file, _, _ in modules.values())
    fullest = max(rooms, key=rooms.__getitem__)
    longest = max(modules.items(), key=lambda item: item[1][2])
    functions = [
        (node.end_lineno - node.lineno + 1, f'{name}.{node.name}')
        for name, (_, tree, _) in modules.items() for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]  # fmt: skip
    methods = [
        (sum(isinstance(n, ast.FunctionDef) for n in node.body), f'{name}.{node.name}')
        for name, (_, tree, _) in modules.items() for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]  # fmt: skip
    named = [name for _, tree, _ in modules.values() for name in constants(tree)]
    settings = [t for name, (_, t, _) in modules.items() if name == 'cg_sysid.search.settings']
    repeated = [name for name, count in Counter(named).items() if count > 1]
    told = f'{len(named)}'
    if settings:
        told += f' + {sum(map(thresholds, settings))} by stage'
    return {
        'modules, rooms': f'{len(modules)}, {len(rooms)}',
        'fullest room': f'{rooms[fullest]} ({fullest.relative_to(checkout / "src").as_posix()})',
        'longest file': f'{longest[1][2]} ({longest[0]})',
        'longest function': '{} ({})'.format(*max(functions)),
        'most methods': '{} ({})'.format(*max(methods)),
        'constants': told,
        'said more than once': str(len(repeated)),
        'import floors, cg_sysid': str(depth(modules, 'cg_sysid')),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('checkouts', nargs='*', type=Path)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    checkouts = [*options.checkouts, ROOT]
    columns = [column(checkout.resolve()) for checkout in checkouts]
    names = [_commit(checkout) for checkout in checkouts]
    lines = [f'| | {" | ".join(names)} |', '|---|' + '---|' * len(names)]
    lines += [f'| {row} | {" | ".join(c[row] for c in columns)} |' for row in columns[0]]
    print('\n'.join(lines))
    if options.write:
        options.write.write_text('\n'.join([
            '# The house', '', 'Command: `./cg exec python bench/house.py CHECKOUT`, whose head '
            'says what each row counts. Columns are commits.', '', *lines, '',
        ]))  # fmt: skip


def _commit(checkout: Path) -> str:
    command = ['git', '-C', str(checkout), 'rev-parse', '--short', 'HEAD']
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == '__main__':
    main()
