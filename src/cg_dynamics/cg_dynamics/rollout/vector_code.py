"""CasADi functions written out as C on vectors of doubles, one lane of a register for each case.

What depends on parameters alone is computed once, ahead of all calls.
"""

from pathlib import Path

import casadi as ca

from cg_dynamics.errors import DynamicsError

WIDTH = 8
# No -fassociative-math: vector_math.c rounds by adding and subtracting a large number.
FLAGS = (
    '-O2', '-march=native', '-fno-math-errno', '-fno-trapping-math', '-fno-signed-zeros',
    '-freciprocal-math', '-ffp-contract=fast',
)  # fmt: skip

BINARY = {
    ca.OP_ADD: '{0} + {1}',
    ca.OP_SUB: '{0} - {1}',
    ca.OP_MUL: '{0} * {1}',
    ca.OP_DIV: '{0} / {1}',
    ca.OP_POW: 'v_pow({0}, {1})',
    ca.OP_CONSTPOW: 'v_pow({0}, {1})',
    ca.OP_ATAN2: 'v_atan2({0}, {1})',
    ca.OP_HYPOT: 'v_hypot({0}, {1})',
    ca.OP_FMIN: 'v_fmin({0}, {1})',
    ca.OP_FMAX: 'v_fmax({0}, {1})',
    ca.OP_LT: 'v_truth({0} < {1})',
    ca.OP_LE: 'v_truth({0} <= {1})',
    ca.OP_EQ: 'v_truth({0} == {1})',
    ca.OP_NE: 'v_truth({0} != {1})',
    ca.OP_AND: 'v_truth(({0} != 0.0) & ({1} != 0.0))',
    ca.OP_OR: 'v_truth(({0} != 0.0) | ({1} != 0.0))',
    ca.OP_COPYSIGN: 'v_copysign({0}, {1})',
    ca.OP_IF_ELSE_ZERO: 'v_select({0} != 0.0, {1}, SPLAT(0.0))',
}
UNARY = {
    ca.OP_NEG: '-{0}',
    ca.OP_SQ: '{0} * {0}',
    ca.OP_TWICE: '{0} + {0}',
    ca.OP_INV: '1.0 / {0}',
    ca.OP_NOT: 'v_truth({0} == 0.0)',
    ca.OP_ASSIGN: '{0}',
    **{
        getattr(ca, f'OP_{name.upper()}'): f'v_{name}({{0}})'
        for name in (
            'sqrt', 'exp', 'log', 'tan', 'tanh', 'sinh', 'cosh', 'asin', 'acos', 'atan', 'fabs',
            'floor', 'ceil', 'sign',
        )
    },
}  # fmt: skip


class UnsupportedError(DynamicsError):
    """An expression with an operation that has no vector form."""


def vector_math() -> str:
    """C source of the elementary functions that vector code calls; WIDTH is defined before it."""
    return (Path(__file__).parent / 'vector_math.c').read_text()


def vector_code(f: ca.Function, name: str, prepare: str, inline: bool = True) -> tuple[str, int]:
    """A function (x, u, p) -> y as two C functions on vectors.

    Args:
        f: The function; its result is dense.
        name: Of name(x, u, s, dx), which fills dx with y.
        prepare: Of prepare(p, s), which fills s with what depends on the parameters alone.
        inline: Wherever it is called; else it is compiled once.

    Returns:
        The source, and how many values s holds.

    Raises:
        UnsupportedError: for an operation that has no vector form.
    """
    before, statements, shared = _vector_form(f)
    linkage = 'static inline __attribute__((always_inline))' if inline else 'static'
    return '\n'.join([
        f'static void {prepare}(const vd *p, vd *s)\n{{',
        *before,
        f'}}\n{linkage} void {name}(const vd *x, const vd *u,'
        ' const vd *s, vd *dx)\n{',
        *statements,
        '}',
    ]), shared  # fmt: skip


def _vector_form(f: ca.Function) -> tuple[list[str], list[str], int]:
    """Statements of `prepare` and of `rates`, and the number of values that they share."""
    prepare: list[str] = []
    rates: list[str] = []
    value: dict[int, str] = {}  # work place of the function -> name of the value it holds now
    still: dict[str, bool] = {}  # name -> depends on no state and no input
    shared: dict[str, int] = {}
    angles: dict[str, str] = {}  # name of an angle -> suffix of its sine and cosine

    def seen_from(name: str, calm: bool) -> str:
        """The value under the name that it has in `prepare` (calm) or in `rates`."""
        if calm or not still[name] or name.startswith('SPLAT'):
            return name
        if name not in shared:
            shared[name] = len(shared)
            prepare.append(f'    s[{shared[name]}] = {name};')
        return f's[{shared[name]}]'

    for k in range(f.n_instructions()):
        op = f.instruction_id(k)
        inputs, outputs = f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_CONST:
            name = f'SPLAT({f.instruction_constant(k)!r})'
            value[outputs[0]], still[name] = name, True
            continue
        if op == ca.OP_INPUT:
            which, index = inputs
            name = f'{"xup"[which]}[{index}]'
            value[outputs[0]], still[name] = name, which == 2
            continue
        if op == ca.OP_OUTPUT:
            name = value[inputs[0]]
            rates.append(f'    dx[{outputs[1]}] = {seen_from(name, False)};')
            continue
        names = [value[place] for place in inputs]
        calm = all(still[name] for name in names)
        body = prepare if calm else rates
        operands = [seen_from(name, calm) for name in names]
        if op in (ca.OP_SIN, ca.OP_COS):
            if names[0] not in angles:
                angles[names[0]] = str(k)
                body.append(f'    vd s{k}, c{k}; v_sincos({operands[0]}, &s{k}, &c{k});')
            name = f'{"s" if op == ca.OP_SIN else "c"}{angles[names[0]]}'
        else:
            form = BINARY.get(op) or UNARY.get(op)
            if form is None:
                raise UnsupportedError(f'no vector form of the operation {op} of {f.name()!r}')
            name = f'a{k}'
            body.append(f'    const vd {name} = {form.format(*operands)};')
        value[outputs[0]], still[name] = name, calm
    return prepare, rates, len(shared)
