# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop bag info`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pdeloop.bags.reader import Bag
from pdeloop.output import aligned
from tuner_node.narration import span

SHOWN = 40
"""Episodes that are listed for people."""


def describe(path: Path) -> dict[str, Any]:
    """Summarise the bag at `path`: the content of `pdeloop bag info --json`."""
    bag = Bag(path)
    found, findings = bag.survey, bag.findings()
    first, last = found.first, found.last
    episodes = []
    for episode in bag.episodes():
        episodes.append(
            {
                "namespace": episode.key[0],
                "run": episode.key[1],
                "episode": episode.number,
                "name": episode.name,
                "environments": episode.environments,
                "exploratory": episode.exploratory,
                "state_every": episode.state_every,
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
        "missing": findings.missing,
        "differences": findings.differences,
        "messages": found.counts.total(),
        "first": first,
        "last": last,
        "seconds": 0.0 if first is None or last is None else (last - first) / 1e9,
        "topics": [
            {"topic": topic, "type": kind, "messages": count}
            for (topic, kind), count in sorted(found.counts.items())
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
        lines.append("  not finished: its recorder was stopped; this lists what it had written")
    lines += [f"  missing: {text}" for text in content["missing"]]
    lines += [f"  {text}" for text in content["differences"]]
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
    if episodes:
        lines += ["", *(f"  {line}" for line in _listed(episodes))]
    return "\n".join(lines)


def _listed(episodes: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each of the first episodes."""
    several = len({episode["namespace"] for episode in episodes}) > 1
    rows = [("episode", "environments", "seconds", "mean stage cost")]
    notes = [""]
    for episode in episodes[:SHOWN]:
        costs = episode["mean_cost"]
        spread = "" if costs is None else span(costs, ".4g")
        rows.append(
            (episode["name"], str(episode["environments"]), f"{episode['seconds']:.2f}", spread)
        )
        found = ["exploratory"] if episode["exploratory"] else []
        every = episode["state_every"]
        found += [f"a state every {every} steps"] if every > 1 else []
        found += [f"lacks {what}" for what in episode["missing"]]
        found += [f"of {episode['namespace']}"] if several else []
        notes.append(", ".join(found))
    lines = [f"{row}  {note}".rstrip() for row, note in zip(aligned(rows, 0), notes, strict=True)]
    more = len(episodes) - SHOWN
    return [*lines, f"and {more} more, which --json lists"] if more > 0 else lines
