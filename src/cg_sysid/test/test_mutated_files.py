"""Damaged recordings: what is intact is kept, nothing ends in a traceback, limits hold."""

import random
import resource
import struct
import time
import zlib

import lz4.frame
import pytest
import zstandard
from mutated_files import (
    DAMAGES,
    FILES,
    START_NS,
    content_of,
    intact,
    make_original,
    place,
    script,
    write_foreign_bag,
    write_own_bag,
)

from cg_sysid.errors import RecordingError
from cg_sysid.records.bags import read_bag
from cg_sysid.records.mcap_records import LARGEST_CHUNK, MAGIC
from cg_sysid.records.mcap_scan import survey
from cg_sysid.records.recover import RecoveryError, is_damaged, main, recover

MUTANTS = 3  # of each kind of file and damage; bench/mutated_bags.py takes 10^5
NOTE = {'mechanism': 'pendulum', 'setup': {}}  # the one in the bag is in the damaged chunk
CHECKED = ('journal', 'own bag', 'lz4 chunks')  # with CRCs: nothing false can pass


@pytest.fixture(scope='module')
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp('originals')
    return {kind: make_original(kind, folder, samples=20) for kind in FILES}


def refusal(task, bag):
    """What the error says with which a bag is refused; empty if it is not."""
    try:
        task(bag)
    except (RecoveryError, RecordingError) as error:
        return str(error)
    return ''


@pytest.mark.parametrize('damage', DAMAGES)
@pytest.mark.parametrize('kind', FILES)
def test_recover_keeps_what_is_intact(tmp_path, originals, kind, damage):
    original, rng = originals[kind], random.Random(f'{kind} {damage}')
    for _ in range(MUTANTS):
        changed = DAMAGES[damage](original.data, rng)
        bag = place(tmp_path / 'bag', original, changed)
        wanted, found = intact(original, changed), set()
        if refusal(recover, bag):
            assert 'no message that can be read' in refusal(recover, bag)
        else:
            found = set(content_of(bag))
        if damage != 'eight bits':  # which may hit every copy of a channel
            assert wanted <= found
        if kind in CHECKED and damage != 'eight bits':
            assert found <= original.messages


def test_every_bit_of_a_journal_may_flip(tmp_path, originals):
    original = originals['journal']
    rng = random.Random(7)
    for bit in rng.sample(range(8 * len(original.data)), 40):
        changed = bytearray(original.data)
        changed[bit // 8] ^= 1 << bit % 8
        bag = place(tmp_path / 'bag', original, bytes(changed))
        assert recover(bag).messages >= len(original.messages) - 1


@pytest.mark.parametrize('write', [write_own_bag, write_foreign_bag])
def test_readers_say_in_one_line_what_is_wrong(tmp_path, write):
    file = write(tmp_path / 'bag', script(20))
    data, rng = file.read_bytes(), random.Random(3)
    metadata = (file.parent / 'metadata.yaml').read_text()
    refused = 0
    for k in range(60):
        damage = list(DAMAGES.values())[k % len(DAMAGES)]
        if k % 6:
            file.write_bytes(damage(data, rng))
        else:
            file.write_bytes(data)
            text = damage(metadata.encode(), rng)
            (file.parent / 'metadata.yaml').write_bytes(text)
        said = refusal(read_bag, file.parent)
        if said:
            refused += 1
            assert str(tmp_path) in said
            assert '\n' not in said
        (file.parent / 'metadata.yaml').write_text(metadata)
    assert refused > 30


def test_a_damaged_bag_is_recovered_without_being_told_to(tmp_path, capsys):
    file = write_own_bag(tmp_path / 'bag', script(20))
    data = bytearray(file.read_bytes())
    assert not is_damaged(file.parent)
    data[len(MAGIC) + 500] ^= 1
    file.write_bytes(data)
    with pytest.raises(RecordingError, match=r'damaged at bytes .* cg_sysid recover'):
        read_bag(file.parent)
    assert main([str(file.parent)]) == 0
    said = capsys.readouterr().out
    assert 'messages recovered\n' in said
    assert 'the CRC of a chunk does not fit; about' in said
    assert not is_damaged(file.parent)
    assert len(read_bag(file.parent, note=NOTE)) > 10
    assert file.with_name('bag.mcap.damaged').read_bytes() == data


def chunk(packed, compression, size, crc=0):
    name = compression.encode()
    content = struct.pack('<QQQII', START_NS, START_NS, size, crc, len(name)) + name
    content += struct.pack('<Q', len(packed)) + packed
    return struct.pack('<BQ', 6, len(content)) + content


GIGABYTE = 10**9
ZEROS = bytes(10**6)


def zstd_bomb(stated):
    packer = zstandard.ZstdCompressor(level=19).compressobj(size=GIGABYTE if stated else -1)
    return b''.join(packer.compress(ZEROS) for _ in range(1000)) + packer.flush()


def lz4_bomb():
    packer = lz4.frame.LZ4FrameCompressor()
    return packer.begin() + packer.compress(bytes(2 * LARGEST_CHUNK)) + packer.flush()


@pytest.mark.parametrize(
    ('packed', 'compression', 'size'),
    [
        (zstd_bomb(True), 'zstd', GIGABYTE),
        (zstd_bomb(True), 'zstd', 1000),
        (zstd_bomb(False), 'zstd', 1000),
        (zstd_bomb(False), 'zstd', LARGEST_CHUNK),
        (lz4_bomb(), 'lz4', 1000),
        (lz4_bomb(), 'lz4', 2 * LARGEST_CHUNK),
    ],
)
def test_a_bomb_stops_at_the_limit(tmp_path, packed, compression, size):
    file = tmp_path / 'bomb.mcap'
    header = struct.pack('<BQ', 1, 8) + bytes(8)
    crc = zlib.crc32(b'whatever')
    end = struct.pack('<BQIBQQQI', 15, 4, 0, 2, 20, 0, 0, 0) + MAGIC
    file.write_bytes(MAGIC + header + chunk(packed, compression, size, crc) + end)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    with pytest.raises(RecoveryError, match=r'unpacks? to|does not') as caught:
        recover(file)
    assert '\n' not in str(caught.value)
    with pytest.raises(RecordingError, match=r'unpacks? to|does not'):
        read_bag(file)
    # Twice the largest chunk in kB; a gigabyte takes longer than this to unpack.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2.5 * LARGEST_CHUNK / 1024
    assert time.process_time() - began < 2.0


def test_many_bombs_stop_at_the_limit_of_a_file(tmp_path):
    zeros = zstandard.compress(bytes(LARGEST_CHUNK))
    file = tmp_path / 'bombs.mcap'
    file.write_bytes(MAGIC + 50 * chunk(zeros, 'zstd', LARGEST_CHUNK, crc=1))
    found = survey(file)
    assert 'unpacks to more than 1000 times its size' in found.gaps[-1].reason


@pytest.mark.parametrize('gone', [slice(0, 2000), slice(-1500, None)])
def test_one_copy_of_the_message_types_is_enough(tmp_path, originals, gone):
    original = originals['own bag']
    changed = bytearray(original.data)
    changed[gone] = bytes(len(changed[gone]))
    bag = place(tmp_path / 'bag', original, bytes(changed))
    recover(bag)
    assert set(content_of(bag)) >= intact(original, bytes(changed))
