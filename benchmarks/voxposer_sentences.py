"""How much of ordinary language the offline writer understands: the scores of the two sets in ``tests/data/``.

    python benchmarks/voxposer_sentences.py                          # the table
    python benchmarks/voxposer_sentences.py --failures               # and the failures of the tuned halves
    python benchmarks/voxposer_sentences.py --sets second            # one set only

Each sentence is planned and carried out in a world without physics, and the relations at the end are compared with
those in the file. Of the held-out halves only counts are printed, so that the grammar can be tuned without them;
``--failures all`` prints those halves too.
"""

from __future__ import annotations

import argparse
import collections

from common import report
from support.sentences import FILES, HALVES, VERDICTS, judge, load


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", nargs="?", const="tuned", choices=["tuned", "all"], help="print failures")
    parser.add_argument("--sets", nargs="+", default=[*FILES], choices=[*FILES], help="which sets to score")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.sets:
        counts: dict[str, collections.Counter[str]] = {half: collections.Counter() for half in HALVES}
        for sentence in load(name):
            verdict = judge(sentence)
            counts[sentence.half][verdict.kind] += 1
            if verdict.kind != "right" and arguments.failures in {"all", sentence.half}:
                print(f"{verdict.kind}: {sentence.scene}: {sentence.say}\n    {verdict.detail[:300]}")
        counts["all"] = sum(counts.values(), collections.Counter())
        rows += [
            {
                "set": name,
                "half": half,
                "sentences": count.total(),
                **{kind: count[kind] for kind in VERDICTS},
                "right %": 100 * count["right"] / count.total(),
            }
            for half, count in counts.items()
        ]
    report("voxposer_sentences", rows, title="Sentences understood by offline/libero")


if __name__ == "__main__":
    main()
