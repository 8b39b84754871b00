// What the cell is at: one word that is read from two metres, a sentence beside it, and where everything stands.

import { byId, deg, el, figure, mm, remake, say, seconds, words } from './dom.js';

const ENDS = { refused: 'REFUSED', misplaced: 'MISPLACED', faulted: 'FAULT', failed: 'FAULT', aborted: 'STOPPED' };

// Word, kind (for its colour) and sentence of a state.
export function mood({ run, question, last, starting, safety, devices, manual, queue }) {
  if (question) return ['WAITS FOR YOU', 'wait', question.reason];
  if (run === null && starting) return ['STARTING', 'busy', `Starting ${words(starting)} …`];
  if (run && run.state === 'paused') return ['PAUSED', 'wait', 'The run holds. Press Go on, or Abort.'];
  if (run && manual) return ['MANUAL', 'busy', 'Manual mode: what is pressed moves.'];
  if (run) {
    const left = Number.isFinite(run.left_s) ? `, about ${seconds(run.left_s)} left` : '';
    const doing = [words(run.step), run.text].filter(Boolean).join(': ') || 'begins …';
    return [run.state === 'pausing' ? 'PAUSING' : 'RUNNING', 'busy', `${words(run.kind)} ${run.job ?? ''}: ${doing}${left}`];
  }
  const sick = Object.values(devices).find((device) => !device.ok)?.fault;
  if (sick) return ['FAULT', 'bad', [sick.text, sick.remedy].filter(Boolean).join('. ')];
  if (safety.stopped) return [ENDS[last?.outcome] ?? 'STOPPED', 'bad', last?.reason ?? 'The cell was stopped. Look at it, then clear the stop.'];
  if (queue?.state === 'holding') return ['QUEUE HOLDS', 'wait', `The next part begins when Go on is pressed. ${ended(last)}`];
  if (queue?.state === 'running') return ['RUNNING', 'busy', 'The next part of the queue begins.'];
  if (last?.outcome === 'placed') return [`PLACED ${placed(last)}`.trim(), 'good', ended(last)];
  return ['READY', 'good', last ? ended(last) : 'Nothing is going on.'];
}

const placed = ({ figure: error }) => (error ? `${error.kind === 'true' ? '' : '± '}${figure(error.mm)} mm` : '');

// How a run ended, as a sentence.
export function ended(last) {
  if (!last) return 'Nothing is going on.';
  const said = `Last ${words(last.kind)}: ${last.outcome}`;
  const error = last.figure;
  if (error?.kind === 'true') return `${said}, true place error ${figure(error.mm)} mm (known in simulation alone)`;
  if (error) return `${said}, stated within ${figure(error.mm)} mm (95 % of its points; reckoned, not measured)`;
  return said + (last.reason && last.outcome !== 'placed' && last.reason !== `${last.kind} done` ? `. ${last.reason}` : '');
}

export function status(state) {
  const [word, kind, sentence] = mood(state);
  say(byId('state'), word);
  byId('status').className = kind;
  say(byId('state-text'), sentence.charAt(0).toUpperCase() + sentence.slice(1));
  positions(state);
}

function positions({ joints, flange, rail, vehicle }) {
  const three = (values, unit) => (values ? values.map((value) => unit(value)) : ['?', '?', '?']);
  const rows = [
    ['Joints 1–3', ...three(joints?.slice(0, 3), deg)],
    ['Joints 4–6', ...three(joints?.slice(3), deg)],
    ['Flange, mm', ...three(flange?.slice(0, 3), (v) => (1e3 * v).toFixed(1))],
    ['turned', ...three(flange?.slice(3), deg)],
    ['Vehicle', ...(vehicle ? [mm(vehicle.x, 0), mm(vehicle.y, 0), deg(vehicle.yaw)] : ['?', '?', '?'])],
    ['drives at', vehicle ? `${mm(vehicle.speed, 0)}/s` : '?', vehicle ? deg(vehicle.yaw_rate) + '/s' : '?', { true: 'braked', false: 'brake open' }[vehicle?.braked] ?? 'brake ?'],
    ['Rail', rail === null ? '?' : mm(rail, 2), '', ''],
  ];
  remake(byId('positions').querySelector('tbody'), rows, () => rows.map(([name, ...cells]) => el('tr', {},
    el('th', { scope: 'row', textContent: name }), ...cells.map((textContent) => el('td', { textContent })))));
}
