"""How much of ordinary language the offline writer understands: the score of ``tests/data/voxposer_sentences.yaml``.

    python benchmarks/voxposer_sentences.py                  # the table
    python benchmarks/voxposer_sentences.py --failures       # and the failures of the tuned half

Each sentence is planned and carried out in a world without physics, and the relations at the end are compared with
those in the file. Of the held-out half only counts are printed, so that the grammar can be tuned without it;
``--failures all`` prints that half too.
"""

from __future__ import annotations

import argparse
import collections

from common import report
from support.sentences import HALVES, VERDICTS, judge, load


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", nargs="?", const="tuned", choices=["tuned", "all"], help="print failures")
    arguments = parser.parse_args()
    counts: dict[str, collections.Counter[str]] = {half: collections.Counter() for half in HALVES}
    for sentence in load():
        verdict = judge(sentence)
        counts[sentence.half][verdict.kind] += 1
        if verdict.kind != "right" and (arguments.failures == "all" or arguments.failures == sentence.half):
            print(f"{verdict.kind}: {sentence.scene}: {sentence.say}\n    {verdict.detail[:300]}")
    counts["all"] = sum(counts.values(), collections.Counter())
    rows = [
        {
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
