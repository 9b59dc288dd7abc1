"""`pdeloop bag info` and `pdeloop bag recover`."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

from pdeloop.bags.reader import Bag
from recorder_node.bag import BagError, BagWriter
from recorder_node.recording import INDEX, PARAMETERS


def describe(path: Path) -> dict[str, Any]:
    """What is in the bag at `path`; the content of `pdeloop bag info --json`."""
    bag = Bag(path)
    counts: Counter[tuple[str, str]] = Counter()
    first, last = None, None
    for message in bag.messages():
        counts[message.topic, message.type] += 1
        first = message.when if first is None else min(first, message.when)
        last = message.when if last is None else max(last, message.when)
    episodes = []
    for episode in bag.episodes():
        episodes.append(
            {
                "namespace": episode.key[0],
                "run": episode.key[1],
                "episode": episode.number,
                "environments": episode.environments,
                "exploratory": episode.exploratory,
                "seconds": (episode.last - episode.first) / 1e9,
                "mean_cost": None if episode.cost is None else episode.cost.values[:, 0].tolist(),
                "missing": episode.missing,
            }
        )
    return {
        "bag": str(bag.path),
        "files": len(bag.files),
        "finished": bag.finished,
        "bytes": sum(file.stat().st_size for file in bag.files),
        "messages": sum(counts.values()),
        "first": first,
        "last": last,
        "seconds": 0.0 if first is None or last is None else (last - first) / 1e9,
        "topics": [
            {"topic": topic, "type": kind, "messages": count}
            for (topic, kind), count in sorted(counts.items())
        ],
        "runs": sorted(bag.parameters()),
        "episodes": episodes,
    }


def info_text(content: dict[str, Any]) -> str:
    """`describe` for people."""
    episodes = content["episodes"]
    incomplete = [episode for episode in episodes if episode["missing"]]
    files = "" if content["files"] == 1 else f" in {content['files']} files"
    lines = [
        f"{content['bag']}: {content['messages']} messages{files}, "
        f"{content['bytes'] / 1e6:.1f} MB, {content['seconds']:.1f} s"
    ]
    if not content["finished"]:
        lines.append(
            "  not finished: its recorder was stopped; what follows is what it had written "
            f"(pdeloop bag recover {content['bag']} makes an ordinary bag of it)"
        )
    width = max((len(topic["topic"]) for topic in content["topics"]), default=0)
    lines += [
        f"  {topic['topic']:<{width}}  {topic['messages']:>9}  {topic['type']}"
        for topic in content["topics"]
    ]
    exploratory = sum(episode["exploratory"] for episode in episodes)
    lines.append(
        f"  {len(episodes)} episodes, {exploratory} of them exploratory, "
        f"{len(incomplete)} incomplete"
    )
    lines += [
        f"  episode {episode['episode']} lacks {', '.join(episode['missing'])}"
        for episode in incomplete[:10]
    ]
    return "\n".join(lines)


def recover(path: Path, out: Path | None) -> tuple[Path, int]:
    """Write an ordinary bag with what an unfinished one holds; returns its path and its messages.

    out: the new folder; PATH-recovered if not given. The old bag stays as it is.
    """
    bag = Bag(path)
    target = out or bag.path.with_name(f"{bag.path.name}-recovered")
    if target.exists():
        raise BagError(f"{target} already exists; give another folder with --out")
    writer = BagWriter(target, bag.channels())
    count = 0
    for message in bag.messages():
        count += 1
        writer.write(message.topic, message.when, message.data)
        writer.pause()
    writer.close({})
    for name in (INDEX, PARAMETERS):
        if (bag.path / name).exists():
            shutil.copyfile(bag.path / name, target / name)
    return target, count
