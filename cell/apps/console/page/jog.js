// Manual mode: steps, and motion for as long as a button is held. The watchdog stands beside the device, not here: a
// beat goes out while the button is held, and whatever ends the beats ends the motion.

import { byId, el, quantity, say, show, words } from './dom.js';

const HOLD = 'hold';

export class Jog {
  constructor(link, ask) {
    this.link = link;
    this.ask = ask;
    this.press = 0;
    this.held = null;
    this.entries = [];
    this.group = null;
    this.size = HOLD;
    byId('manual').onclick = () => ask('manual', { on: byId('manual').getAttribute('aria-pressed') !== 'true' });
    byId('speed').oninput = () => say(byId('speed-said'), `${byId('speed').value} %`);
    byId('speed').onchange = () => ask('speed', { fraction: byId('speed').value / 100 });
    for (const [target, type] of [[window, 'blur'], [window, 'pagehide'], [document, 'visibilitychange'], [document, 'freeze']]) {
      target.addEventListener(type, () => this.end(type));
    }
    // A second finger, anywhere.
    document.addEventListener('pointerdown', (event) => {
      if (this.held && event.pointerId !== this.held.pointer) this.end('second touch');
    }, true);
    document.addEventListener('touchstart', (event) => { if (event.touches.length > 1) this.end('second touch'); }, true);
    link.on('closed', () => this.end('lost link'));
    link.on('freshness', ({ stale }) => { if (stale) this.end('lost link'); });
    link.on('jog', (message) => this.told(message));
  }

  cell(cell) {
    this.entries = cell.jog;
    this.group = null;
    this.build();
  }

  state(state, mine) {
    const manual = Boolean(state.manual);
    if (!manual || !mine) this.end('manual mode is off');
    const button = byId('manual');
    button.disabled = !mine || (state.run !== null && !manual);
    button.setAttribute('aria-pressed', String(manual));
    say(button, manual ? 'Switch off' : 'Switch on');
    show(byId('jog-panel'), manual && mine);
    byId('side').classList.toggle('manual', manual && mine);
    byId('speed').disabled = !mine;
    if (document.activeElement !== byId('speed')) {
      byId('speed').value = Math.round(100 * state.speed);
      say(byId('speed-said'), `${Math.round(100 * state.speed)} %`);
    }
  }

  groupOf(entry) {
    if (entry.device !== 'arm') return words(entry.device);
    if (entry.axis.startsWith('j')) return 'arm joints';
    return entry.axis.startsWith('r') ? 'arm turns' : 'arm x y z';
  }

  build() {
    const groups = [...new Set(this.entries.map((entry) => this.groupOf(entry)))];
    if (!groups.includes(this.group)) [this.group] = groups;
    const entries = this.entries.filter((entry) => this.groupOf(entry) === this.group);
    const hold = entries.every((entry) => entry.hold);
    const count = Math.min(...entries.map((entry) => entry.steps.length));
    if (this.size === HOLD ? !hold : this.size >= count) this.size = hold ? HOLD : 0;
    const choice = (text, chosen, choose) => el('button', { type: 'button', textContent: text, 'aria-pressed': String(chosen), onclick: () => { this.end('changed'); choose(); this.build(); } });
    byId('jog-devices').replaceChildren(...groups.map((name) => choice(name, name === this.group, () => { this.group = name; })));
    const sizes = [...(hold ? [HOLD] : []), ...Array(count).keys()];
    byId('jog-sizes').replaceChildren(...sizes.map((size) => choice(this.sized(entries, size), size === this.size, () => { this.size = size; })));
    byId('jog-axes').replaceChildren(...entries.map((entry) => this.row(entry)));
  }

  sized(entries, size) {
    if (size === HOLD) return 'hold to move';
    return [...new Set(entries.map((entry) => quantity(entry.steps[size], entry.unit)))].join(' / ');
  }

  row(entry) {
    const name = entry.axis ? words(entry.axis) : words(entry.device);
    const sign = (way) => {
      const mark = way > 0 ? '+' : '−';
      const button = el('button', { type: 'button', className: 'hold-button', textContent: mark, 'aria-label': `jog ${entry.device} ${entry.axis} ${mark}` });
      this.wire(button, entry, way);
      return button;
    };
    return el('div', { className: 'axis' }, sign(-1), el('span', { textContent: name }), sign(1));
  }

  wire(button, entry, sign) {
    button.addEventListener('pointerdown', (event) => {
      if (event.button !== 0 || !event.isPrimary) return;
      event.preventDefault();
      button.focus();
      if (this.size === HOLD) {
        button.setPointerCapture(event.pointerId);
        this.begin(button, entry, sign, event.pointerId);
      } else {
        this.step(entry, sign);
      }
    });
    for (const type of ['pointerup', 'pointercancel', 'lostpointercapture', 'blur']) {
      button.addEventListener(type, () => { if (this.held?.button === button) this.end(type); });
    }
    button.addEventListener('pointermove', (event) => {
      if (this.held?.button !== button || event.pointerId !== this.held.pointer) return;
      const box = button.getBoundingClientRect();
      const inside = event.clientX >= box.left && event.clientX <= box.right && event.clientY >= box.top && event.clientY <= box.bottom;
      if (!inside) this.end('slid off');
      // Another button of a mouse that is down already comes as a move.
      if (event.buttons > 1) this.end('second button');
    });
    button.addEventListener('contextmenu', (event) => event.preventDefault());
    button.addEventListener('keydown', (event) => this.key(event, button, entry, sign));
    button.addEventListener('keyup', () => { if (this.held?.pointer === 'key') this.end('released'); });
  }

  key(event, button, entry, sign) {
    if (![' ', 'Enter'].includes(event.key)) return;
    event.preventDefault();
    if (event.repeat || this.held) return;
    if (!byId('jog-keys').checked) say(byId('jog-said'), 'Keys do not jog unless that is switched on below.');
    else if (this.size === HOLD) this.begin(button, entry, sign, 'key');
    else this.step(entry, sign);
  }

  async step(entry, sign) {
    const amount = sign * entry.steps[this.size];
    const answer = await this.ask('jog_step', { device: entry.device, axis: entry.axis, amount });
    say(byId('jog-said'), answer.text ?? '');
  }

  begin(button, entry, sign, pointer) {
    if (this.held) return this.end('second touch');
    this.press += 1;
    const message = { type: 'jog', press: this.press, device: entry.device, axis: entry.axis, sign };
    // With the page's own time: one that was long on its way counts for nothing.
    const beat = () => { if (!this.link.send({ ...message, at: performance.now() })) this.end('lost link'); };
    this.held = { button, pointer, press: this.press, timer: setInterval(beat, this.link.hello?.beat_ms ?? 80) };
    button.classList.add('held');
    say(byId('jog-said'), `Moving ${words(entry.device)} ${entry.axis} …`);
    return beat();
  }

  end(why) {
    if (!this.held) return;
    const { button, timer, press } = this.held;
    this.held = null;
    clearInterval(timer);
    this.link.send({ type: 'jog_end', press });
    button.classList.remove('held');
    say(byId('jog-said'), `Let go (${words(why)}).`);
  }

  told(message) {
    if (message.press === this.held?.press && message.state !== 'moving') this.end(message.state);
    if (message.text) say(byId('jog-said'), message.text);
  }
}
