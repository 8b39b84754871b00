// A run that has ended, moved through in the 3-D scene by a slider. The live readings go on beside it; STOP as well.

import { byId, say, seconds, show, words } from './dom.js';

const TICK_MS = 50;

export class Replay {
  // `draw(pose)` shows a moment; `back()` goes back to what is live.
  constructor(link, draw, back) {
    this.link = link;
    this.draw = draw;
    this.back = back;
    this.track = null;
    byId('replay-play').onclick = () => this.play(!this.timer);
    byId('replay-time').oninput = (event) => this.at(Number(event.target.value));
    byId('replay-end').onclick = () => this.close();
  }

  get on() {
    return this.track !== null;
  }

  // Raises when nothing tells how the run moved.
  async open({ run, dry }) {
    const track = await (await this.link.get(`/api/runs/${encodeURIComponent(run)}/replay`)).json();
    this.track = track;
    say(byId('replay-title'), dry ? 'DRY RUN, not live' : `REPLAY of ${run}, not live`);
    byId('replay-time').max = track.times.at(-1);
    show(byId('replay-bar'), true);
    byId('view').classList.add('replaying');
    this.at(track.times[0]);
    this.play(true);
  }

  play(on) {
    clearInterval(this.timer);
    this.timer = null;
    say(byId('replay-play'), on ? 'Hold' : 'Play');
    if (!on) return;
    const { times } = this.track;
    if (this.now >= times.at(-1)) this.now = times[0];
    // A whole run in about twenty seconds.
    const pace = Math.max(1, (times.at(-1) - times[0]) / 20);
    this.timer = setInterval(() => {
      this.at(Math.min(times.at(-1), this.now + pace * TICK_MS / 1e3));
      if (this.now >= times.at(-1)) this.play(false);
    }, TICK_MS);
  }

  at(time) {
    const { times, joints, rail, vehicle, steps, place, laser } = this.track;
    this.now = time;
    byId('replay-time').value = time;
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= time) low = middle; else high = middle - 1;
    }
    const next = Math.min(low + 1, times.length - 1);
    const share = next > low ? (time - times[low]) / (times[next] - times[low]) : 0;
    const between = (a, b) => (a === null || b === null || a === undefined || b === undefined ? a ?? b ?? null : a + (b - a) * share);
    const driven = vehicle?.[low] ? vehicle[low].map((value, k) => between(value, vehicle[next]?.[k])) : null;
    const step = steps?.find(({ begin, end }) => begin <= time && time <= end);
    say(byId('replay-at'), `${seconds(time - times[0])}${step ? ` · ${words(step.name)}` : ''}`);
    this.draw({
      joints: joints[low]?.map((value, k) => between(value, joints[next]?.[k])) ?? null,
      rail: between(rail?.[low], rail?.[next]),
      vehicle: driven && { x: driven[0], y: driven[1], yaw: driven[2] },
      laser: laser?.[low] ?? step?.name === 'laser_sweep',
      place: place ?? null,
    });
  }

  close() {
    clearInterval(this.timer);
    this.timer = null;
    this.track = null;
    show(byId('replay-bar'), false);
    byId('view').classList.remove('replaying');
    this.back();
  }
}
