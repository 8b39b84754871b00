// What the jobs since the calibration have seen of each part: its figures as bars up to their limit, and when it is due.

import { el } from './dom.js';

const NEWEST = 40;

export function health(found) {
  const due = el('p', { className: found.due_now ? 'bad' : 'quiet', textContent: found.due });
  const shocks = found.shocks.map((shock) => el('p', { className: 'bad', textContent: `After run ${shock.run} parts may sit elsewhere: ${shock.reason}` }));
  if (!found.parts.length) return [due, ...shocks];
  const head = el('tr', {}, ...['Part', 'Last', 'By now', 'Limit', 'Creeps a day', 'Each job'].map((text) => el('th', { textContent: text })));
  return [el('table', {}, el('thead', {}, head), el('tbody', {}, ...found.parts.map(row))), due, ...shocks];
}

function row(part) {
  const creeps = part.a_day ? `${part.a_day.toFixed(3)} ${part.unit}` : '';
  const bars = part.values.slice(-NEWEST).map((value) => {
    const bar = el('i', { className: value > part.limit ? 'beyond' : '', title: `${value.toFixed(3)} ${part.unit}` });
    bar.style.height = `${Math.max(4, 100 * Math.min(1, value / part.limit))}%`;
    return bar;
  });
  return el('tr', {},
    el('td', { textContent: part.part }),
    el('td', { textContent: part.last.toFixed(3) }),
    el('td', { textContent: `${part.now.toFixed(3)} ${part.unit}` }),
    el('td', { textContent: `${part.limit.toFixed(2)} ${part.unit}` }),
    el('td', { textContent: creeps }),
    el('td', {}, el('span', { className: 'bars', role: 'img', 'aria-label': `${part.values.length} jobs` }, ...bars)));
}
