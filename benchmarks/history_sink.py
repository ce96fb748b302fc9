"""What a history costs: bytes of a fix on the disk, and CPU of a fix from packed batches to Parquet.

    python benchmarks/history_sink.py                            # 500 tags, 1 Hz, half an hour
    python benchmarks/history_sink.py --tags 2000 --minutes 10

The tracks are random walks with the noise of fixes, of tags that also rest; they arrive in batches of 1,000, as the
journal has them. Aims (SCALE.md): at most 8 bytes and 2 us a fix.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from skyless.run.fix_batch import MAX_RECORDS, RECORD, Batch, decode_batch, encode_batch
from skyless.run.history.layout import current_files
from skyless.run.history.retention import Keep, tidy
from skyless.run.history.writer import Writer

FILE_S = 600.0
BEGIN_S = 1_795_154_400.0
DAY_S = 86_400.0
NOISE_M = 0.03


def tracks(tags, seconds, seed):
    """Batches of fixes in the order of their times, as bytes."""
    draw = np.random.default_rng(seed)
    moves = np.repeat(draw.random((tags, 1 + seconds // 60)) < 0.5, 60, axis=1)[:, :seconds, None]  # by the minute
    heading = np.cumsum(draw.normal(0.0, 0.3, (tags, seconds)), axis=1)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * moves
    ways_m = np.empty((tags, seconds, 3))
    ways_m[..., :2] = draw.uniform(0.0, 100.0, (tags, 1, 2)) + np.cumsum(steps, axis=1)
    ways_m[..., 2] = 1.2
    ways_m += draw.normal(0.0, NOISE_M, ways_m.shape)
    rows = np.zeros((seconds, tags), RECORD)
    rows["tag"] = np.arange(1, tags + 1)
    rows["unix_us"] = (1e6 * (BEGIN_S + np.arange(seconds)[:, None] + np.arange(tags) / tags)).astype(np.uint64)
    rows["unix_us"] += draw.integers(0, 3000, rows.shape).astype(np.uint64)  # slots and hosts are not exact
    rows["position_mm"] = np.rint(1000.0 * ways_m).astype(np.int32).transpose(1, 0, 2)
    variance = NOISE_M**2 * draw.uniform(0.8, 1.3, rows.shape)
    rows["covariance_m2"][..., 0] = rows["covariance_m2"][..., 2] = variance
    rows["std_z_mm"] = np.rint(1500.0 * np.sqrt(variance))
    rows["hpl_cm"] = draw.integers(25, 40, rows.shape)
    rows["flags"] = 1 + 64
    flat = rows.ravel()
    for number, first in enumerate(range(0, len(flat), MAX_RECORDS)):
        records = flat[first : first + MAX_RECORDS]
        sent_us = int(records["unix_us"][-1])
        yield sent_us, encode_batch(Batch(1, number, sent_us, 0, records))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tags", type=int, default=500)
    parser.add_argument("--minutes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    batches = list(tracks(asked.tags, 60 * asked.minutes, asked.seed))
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        writer = Writer(root, 1)
        begun_s, written_s, file_s = time.process_time(), 0.0, BEGIN_S + FILE_S
        for sent_us, batch in batches:
            writer.fixes.add(decode_batch(batch).records, 1e-6 * sent_us)
            begin_s = time.process_time()
            writer.store()
            written_s += time.process_time() - begin_s
            if 1e-6 * sent_us >= file_s:
                writer.write()
                file_s += FILE_S
        writer.write()
        took_s = time.process_time() - begun_s
        size = sum(file.stat().st_size for file in current_files(root, 1))
        fixes = writer.fixes.last
        print(f"{fixes} fixes of {asked.tags} tags in {len(current_files(root, 1))} files")
        print(f"bytes a fix                 {size / fixes:6.2f}")
        print(f"CPU of a fix: files         {1e6 * (took_s - written_s) / fixes:6.2f} us")
        print(f"CPU of a fix: journal       {1e6 * written_s / fixes:6.2f} us")
        for what, days in (("joined", 2), ("thinned", 10)):
            begin_s = time.process_time()
            tidy(root, 1, Keep(), BEGIN_S + days * DAY_S)
            took_s = time.process_time() - begin_s
            left = sum(file.stat().st_size for file in current_files(root, 1))
            print(f"{what + ': bytes, CPU':<28}{left / fixes:6.2f}  {1e6 * took_s / fixes:.2f} us of a fix as received")


if __name__ == "__main__":
    main()
