"""Results folders of one evaluation that was split, as the one folder that a single run would have left.

Folders come in (the shards of ``vecenv eval --shard i/n``, or copies that ran different episodes). ``sources`` checks
that they are about one evaluation, ``folders`` joins their rows and ``artifacts`` what was recorded. Merging may be
repeated as shards finish; what has not run is missing in the merged folder, which can be resumed like any other.
"""

from vecenv_eval.merge.folders import Merged, merge

__all__ = ["Merged", "merge"]
