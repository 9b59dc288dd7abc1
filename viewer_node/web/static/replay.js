// Two sliders for a run that is over: which recorded episode, and when in it.

import { text } from "./format.js";

const find = (id) => document.getElementById(id);

export class Replay {
  // update(): the shown column is another one; choose(index): show another episode.
  constructor(episode, update, choose) {
    this.episode = episode;
    this.update = update;
    find("time").addEventListener("input", () => this.seek());
    find("recorded").addEventListener("change", (event) => choose(Number(event.target.value)));
    find("recorded").addEventListener("input", (event) => {
      find("recorded-text").textContent = `${Number(event.target.value) + 1} of ${this.episodes}`;
    });
  }

  seek() {
    const { episode } = this;
    const column = Number(find("time").value);
    episode.column = column < episode.columns - 1 ? column : null;
    this.say();
    this.update();
  }

  say() {
    const { episode } = this;
    const at = episode.column ?? episode.columns - 1;
    const t = text(episode.time(episode.step(at)));
    find("time-text").textContent = episode.header.sample_time ? `${t} s` : `step ${t}`;
  }

  // recorded: as the status tells it, null while a loop runs.
  status(recorded) {
    find("replay").hidden = !recorded?.episodes;
    this.episodes = recorded?.episodes ?? 0;
    if (!this.episodes) {
      this.episode.column = null;
      return;
    }
    const slider = find("recorded");
    slider.max = String(recorded.episodes - 1);
    if (document.activeElement !== slider) slider.value = String(recorded.chosen);
    find("recorded-text").textContent = `${recorded.chosen + 1} of ${recorded.episodes}: ${recorded.label}`;
  }

  // Another episode has come: its newest state is shown first.
  begin() {
    const slider = find("time");
    slider.max = String(Math.max(0, this.episode.columns - 1));
    slider.value = slider.max;
    this.episode.column = null;
    this.say();
  }
}
