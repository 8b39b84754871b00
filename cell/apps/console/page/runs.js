// Earlier runs: their list, the trend of the place error, one run's report and pictures, and the way to its replay.

import { byId, el, figure, seconds, words } from './dom.js';
import { health } from './health.js';
import { trend } from './trend.js';

export class Runs {
  constructor(link) {
    this.link = link;
  }

  async load() {
    const [runs, points] = await Promise.all(['/api/runs', '/api/trend'].map(async (path) => (await this.link.get(path)).json()));
    byId('trend').replaceChildren(trend(points, (run) => this.open(run)));
    this.health();
    const body = byId('runs').tBodies[0];
    body.replaceChildren(...runs.map((run) => this.row(run)));
    if (!runs.length) body.append(el('tr', {}, el('td', { colSpan: 5, textContent: 'No run yet.' })));
  }

  // Slow beside the lists: it comes when it comes.
  async health() {
    const box = byId('health');
    try {
      box.replaceChildren(...health(await (await this.link.get('/api/health')).json()));
    } catch (problem) {
      box.replaceChildren(el('p', { className: 'bad', textContent: problem.message }));
    }
  }

  row(run) {
    const open = el('button', { type: 'button', className: 'link', textContent: run.run, onclick: () => this.open(run.run) });
    return el('tr', {},
      el('td', {}, open, el('br'), el('small', { textContent: new Date(run.started * 1e3 || run.started).toLocaleString() })),
      el('td', { textContent: [words(run.kind), run.job].filter(Boolean).join(' ') }),
      el('td', { className: `outcome ${run.outcome}`, textContent: run.outcome ?? 'going on', title: run.reason ?? '' }),
      el('td', { textContent: error(run) }),
      el('td', { textContent: seconds(run.duration_s) }));
  }

  async open(run) {
    const box = byId('run-detail');
    const base = `/api/runs/${encodeURIComponent(run)}`;
    try {
      const found = await (await this.link.get(base)).json();
      box.replaceChildren(...this.detail(run, base, found));
    } catch (problem) {
      box.replaceChildren(el('h2', { textContent: run }), el('p', { className: 'bad', textContent: problem.message }));
    }
    box.scrollIntoView({ block: 'nearest' });
  }

  detail(run, base, { report, pictures, replay: replays }) {
    const steps = (report?.steps ?? []).map((step) => el('li', { className: step.state }, `${words(step.name)}: ${words(step.state)}`,
      el('small', { textContent: ` ${step.duration_s?.toFixed?.(1) ?? ''} s${step.retries ? ` · ${step.retries} retries` : ''}` })));
    const replay = el('button', { type: 'button', className: 'main', textContent: 'Replay in 3-D', onclick: () => this.link.tell('replay', { run, job: report?.job?.name ?? report?.job }) });
    return [
      el('h2', { textContent: run }),
      el('p', { className: `outcome ${report?.outcome}`, textContent: `${report?.outcome ?? 'going on'}${reached(report)}` }),
      el('div', { className: 'buttons' }, ...(replays ? [replay] : []), el('a', { href: this.link.ticketed(`${base}/report.html`), target: '_blank', rel: 'noopener', textContent: 'Report' })),
      el('ol', { className: 'plain' }, ...steps),
      ...(pictures ?? []).map((name) => el('img', { src: this.link.ticketed(`${base}/pictures/${encodeURIComponent(name)}`), alt: words(name), loading: 'lazy' })),
    ];
  }
}

// A placed run by its error, every other one by its reason.
function reached(report) {
  const [error, bound] = [report?.truth?.error_mm?.d?.mean, report?.place_bound_95?.d];
  if (report?.outcome !== 'placed') return report?.reason ? `: ${report.reason}` : '';
  return Number.isFinite(error) ? `, true place error ${figure(error)} mm` : Number.isFinite(bound) ? `, stated within ${figure(bound)} mm` : '';
}

function error(run) {
  if (run.d_mean_mm !== null && run.d_mean_mm !== undefined) return `${run.d_mean_mm.toFixed(3)} mm`;
  return run.expected_mm === null || run.expected_mm === undefined ? '' : `± ${run.expected_mm.toFixed(3)} mm stated`;
}
