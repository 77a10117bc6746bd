"""MAT files: the vectors that scipy finds, and one line where a file is damaged."""

import io

import numpy as np
import pytest
import scipy.io

from cg_sysid.records.mat_file import MatError, vectors

TIME = np.linspace(0.0, 1.0, 7)
KINDS = ('f8', 'f4', 'i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'i8', 'u8')
LOG = {
    't': TIME,
    'column': TIME[:, None],
    'flags': TIME > 0.5,
    'empty': np.zeros((0, 3)),
    'nothing': np.zeros((1, 0)),
    'scalar': 3.5,
    'matrix': np.eye(3),
    'cube': np.ones((2, 3, 4)),
    'long_cube': np.arange(5.0).reshape(1, 5, 1),
    'complex': TIME + 1j,
    'text': 'first run',
    'cell': np.array([1.0, 'a', TIME], dtype=object),
    'run': {'angle': np.sin(TIME), 'name': 'x', 'deep': {'rate': TIME * 2, 'none': []}},
    'runs': np.array([(1.0, TIME), (2.0, TIME)], dtype=[('a', object), ('b', object)]),
    **{f'kind_{kind}': (100 * TIME).astype(kind) for kind in KINDS},
}


def written(content, **options):
    file = io.BytesIO()
    scipy.io.savemat(file, content, **options)
    return file.getvalue()


def found_by_scipy(data):
    """The vectors in what scipy reads."""
    found = {}

    def collect(name, value):
        if hasattr(value, '_fieldnames'):
            for field in value._fieldnames:
                collect(f'{name}.{field}', getattr(value, field))
        elif not isinstance(value, np.ndarray) or not value.size:
            pass
        elif value.ndim == 1 and value.dtype.kind in 'biuf':
            found[name] = value.astype(float)

    content = scipy.io.loadmat(io.BytesIO(data), squeeze_me=True, struct_as_record=False)
    for name, value in content.items():
        if not name.startswith('__'):
            collect(name, value)
    return found


@pytest.mark.parametrize('options', [{}, {'do_compression': True}, {'format': '4'}], ids=str)
def test_the_vectors_are_those_that_scipy_finds(options):
    old = options.get('format') == '4'
    log = {
        name: value
        for name, value in LOG.items()
        if not old or (isinstance(value, np.ndarray) and value.ndim < 3 and value.dtype != object)
    }
    data = written({k: v for k, v in log.items() if k != 'runs'}, **options)
    expected, found = found_by_scipy(data), vectors(data)
    assert len(expected) > 8
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, name)


def test_arrays_of_structs_are_passed_over():
    assert list(vectors(written({'runs': LOG['runs'], 't': TIME}))) == ['t']


def test_files_of_the_other_order_of_bytes_are_read():
    """Of version 4: a head of five numbers, a name, the values."""
    head = np.array([1000, 1, 3, 0, 2], '>i4').tobytes()
    data = head + b'q\0' + np.array([1.5, 2.5, 3.5], '>f8').tobytes()
    np.testing.assert_array_equal(vectors(data)['q'], [1.5, 2.5, 3.5])
    np.testing.assert_array_equal(found_by_scipy(data)['q'], [1.5, 2.5, 3.5])


def refused(data):
    """What is said against a file; empty if nothing is."""
    try:
        vectors(data)
    except MatError as error:
        return str(error)
    return ''


def deep(levels):
    tree = {'t': TIME}
    for _ in range(levels):
        tree = {'a': tree}
    return written({'a': tree}, long_field_names=True)


def half_a_width():
    """A struct whose length of field names is 0.5, and no integer."""
    data = written({'a': {'t': TIME}})
    width = np.array([5, 4], '<i2').tobytes()  # a small element of 4 bytes: an int32
    at = data.index(width)
    half = np.array([7, 4], '<i2').tobytes() + np.array(0.5, '<f4').tobytes()
    return data[:at] + half + data[at + 8 :]


@pytest.mark.parametrize(
    ('data', 'said'),
    [
        (b'', 'too short'),
        (b'nothing' * 30, 'order of bytes'),
        (b'\0' * 100, 'head makes no sense'),
        (written({'t': TIME})[:-20], 'longer than the file'),
        (written({'t': TIME}, do_compression=True)[:-9], 'longer than the file'),
        (written({'t': TIME})[:124] + b'\0\x02IM' + b'\0' * 50, r'version 7\.3; save it again'),
        (deep(60), 'nested more than'),
        (half_a_width(), 'a number with a fraction'),
        (written({'t': np.zeros(60_000_000)}, do_compression=True), 'unpacks to more than'),
    ],
    ids=range(9),
)  # fmt: skip
def test_what_is_damaged_or_too_large_is_refused(data, said):
    with pytest.raises(MatError, match=said):
        vectors(data)


@pytest.mark.parametrize('options', [{}, {'do_compression': True}, {'format': '4'}], ids=str)
def test_every_changed_byte_is_taken_or_refused(options):
    """One of them ends a process that reads it with scipy 1.17."""
    data = written({'t': TIME, 'q': np.arange(7)} if options else LOG | {'runs': 1.0}, **options)
    for k in range(len(data)):
        for change in (0x01, 0x80, 0xFF):
            changed = data[:k] + bytes([data[k] ^ change]) + data[k + 1 :]
            refusal = refused(changed)
            assert refusal.isprintable()
            assert len(refusal) < 300
