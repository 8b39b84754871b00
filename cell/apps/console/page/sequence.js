// Where the sequence stands, and what begins, holds and ends it.

import { byId, el, remake, say, seconds, show, words } from './dom.js';
import { ended } from './status.js';

const SIGNS = { open: '○', active: '▶', done: '✓', failed: '✗' };
const MOST_EVENTS = 100;
// How long after an answer a button stays shut, until the state tells of what was begun.
const SEEN_MS = 400;

export class Sequence {
  constructor(link, ask) {
    this.link = link;
    this.ask = ask;
    byId('pause').onclick = () => ask('pause');
    byId('go-on').onclick = () => ask('go_on');
    byId('pace').oninput = () => say(byId('pace-said'), `${byId('pace').value} %`);
    byId('pace').onchange = () => ask('pace', { share: byId('pace').value / 100 });
    byId('abort').onclick = () => ask('abort', { reason: 'a person at the screen' });
    byId('start-form').onsubmit = (event) => {
      event.preventDefault();
      this.begin();
    };
    byId('dry-run').onclick = () => this.rehearse(byId('job').value);
    byId('dry-cancel').onclick = () => ask('cancel_dry_run');
    document.querySelectorAll('[data-do]').forEach((button) => {
      button.onclick = () => this.work(button.dataset.do);
    });
    link.on('event', (event) => this.heard(event));
    link.on('hello', () => byId('events').replaceChildren());
  }

  // Begin something: said at once, and not twice, however long the answer takes.
  async start(name, values, what) {
    if (this.pending) return;
    this.pending = what;
    this.link.tell('state', this.link.state);
    await this.ask(name, values);
    setTimeout(() => { this.pending = null; }, SEEN_MS);
  }

  begin() {
    const values = { job: byId('job').value };
    const count = Number(byId('count').value);
    if (count > 1) values.count = count;
    if (byId('at-start').checked) values.at_start = true;
    if (byId('until').value) values.until = byId('until').value;
    this.start('start', values, count > 1 ? `${count} parts of ${values.job}` : `job ${values.job}`);
  }

  work(name) {
    if (name === 'diag') this.ask(name);
    else this.start(name, name === 'home' ? {} : { job: byId('job').value }, { home: 'homing', calibrate: 'calibration', verify: 'verification' }[name]);
  }

  // The cell that is shown has changed.
  cell(cell) {
    byId('job').replaceChildren(...cell.jobs.map((name) => el('option', { value: name, textContent: name })));
    const until = cell.steps.map((name) => el('option', { value: name, textContent: words(name) }));
    byId('until').replaceChildren(el('option', { value: '', textContent: 'the end' }), ...until);
  }

  state({ run, last, pace, starting, queue, dry_run: dry }, mine) {
    const paused = run !== null && ['pausing', 'paused'].includes(run.state);
    say(byId('run-title'), run ? `${words(run.kind)} ${run.job ?? ''}`.trim() + this.mood(run) : 'No run');
    say(byId('run-text'), run ? this.now(run) : starting ? `Starting ${starting} …` : ended(last));
    byId('run-text').className = !run && !starting && last ? `outcome ${last.outcome}` : 'quiet';
    byId('run-fraction').value = run?.fraction ?? 0;
    say(byId('run-left'), this.time(run));
    show(byId('run-left').parentElement, run !== null);
    remake(byId('steps'), (run?.steps ?? []).map((step) => [step.name, step.state, step.retries, step.reason]), () => this.rows(run));
    show(byId('run-buttons'), run !== null);
    show(byId('start-form'), run === null && (!queue || queue.state === 'ended'));
    byId('pause').disabled = !mine || paused;
    byId('go-on').disabled = !mine || !paused;
    byId('abort').disabled = !mine;
    byId('pace').disabled = !mine;
    if (document.activeElement !== byId('pace')) {
      byId('pace').value = Math.round(100 * pace);
      say(byId('pace-said'), `${Math.round(100 * pace)} %`);
    }
    byId('start-form').querySelectorAll('button, select, input').forEach((control) => { control.disabled = !mine || Boolean(starting); });
    if (dry?.state === 'running') byId('dry-run').disabled = true;
    this.dry(dry ?? null);
  }

  mood(run) {
    return { pausing: ': pausing …', paused: ': PAUSED', asking: ': waits for a person' }[run.state] ?? '';
  }

  now(run) {
    const again = run.attempt > 1 ? ` (attempt ${run.attempt})` : '';
    return run.step ? `${words(run.step)}${again}: ${run.text || '…'}` : run.text || 'begins …';
  }

  time(run) {
    if (!run) return '';
    const left = run.left_s === null || run.left_s === undefined ? '' : `about ${seconds(run.left_s)} left`;
    return [`${seconds(run.elapsed_s)} gone`, left].filter(Boolean).join(', ');
  }

  rows(run) {
    return (run?.steps ?? []).map((step) => el('li', { className: step.state, ...(step.state === 'active' ? { 'aria-current': 'step' } : {}) },
      el('span', { className: 'sign', textContent: SIGNS[step.state] ?? '·', 'aria-hidden': 'true' }),
      el('span', { textContent: words(step.name) }),
      el('span', { className: 'visually-hidden', textContent: step.state }),
      el('small', { textContent: this.figures(step) }),
      ...(step.reason ? [el('p', { textContent: step.reason })] : [])));
  }

  figures(step) {
    const retries = step.retries ? `${step.retries} ${step.retries === 1 ? 'retry' : 'retries'}` : '';
    return [retries, step.duration_s ? `${step.duration_s.toFixed(1)} s` : ''].filter(Boolean).join(' · ');
  }

  // The job on the virtual clock, in a process of its own: nothing moves here.
  async rehearse(job) {
    if ((await this.ask('dry_run', { job })).ok) this.awaited = 'asked';
  }

  // How that goes; when it has ended, whoever asked for it is shown its motion.
  dry(dry) {
    const said = byId('dry-said');
    const computed = dry?.state !== 'running';
    show(byId('dry-bar'), !computed);
    byId('dry-fraction').value = dry?.fraction ?? 0;
    if (!dry) return say(said, '');
    say(said, computed ? `Dry run of ${dry.job}: ${dry.outcome}${dry.reason && dry.outcome !== 'placed' ? `. ${dry.reason}` : ''}` : `Dry run of ${dry.job}: ${dry.text} …`);
    if (!computed && this.awaited === 'asked') this.awaited = 'computing';
    if (computed && this.awaited === 'computing') {
      this.awaited = null;
      if (dry.run) this.link.tell('replay', { run: dry.run, job: dry.job, dry: true });
    }
    return undefined;
  }

  heard(event) {
    const list = byId('events');
    const time = new Date(1e3 * event.t).toLocaleTimeString();
    list.prepend(el('li', { className: event.kind }, el('time', { textContent: time }), ` ${words(event.step)} ${event.text}`));
    while (list.childElementCount > MOST_EVENTS) list.lastElementChild.remove();
  }
}
