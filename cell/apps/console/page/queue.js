// The queue of parts that was begun here: counters by how the parts ended, and what becomes of those to come.

import { byId, el, remake, say, show } from './dom.js';

const ENDS = { placed: 'good', corrected: 'corrected', refused: 'refused', misplaced: 'misplaced', faulted: 'faulted', aborted: 'stopped', 'not tried': 'to come' };

export class Queue {
  constructor(ask) {
    document.querySelectorAll('[data-parts]').forEach((button) => {
      button.onclick = () => ask('queue', { parts: button.dataset.parts });
    });
  }

  state({ queue }, mine) {
    show(byId('queue'), Boolean(queue));
    if (!queue) return;
    const over = queue.state === 'ended';
    say(byId('queue-title'), `Queue of ${queue.count} parts, ${queue.job}`);
    byId('queue-done').value = queue.part / queue.count;
    say(byId('queue-said'), over ? `ended: ${queue.reason}` : `${queue.part} of ${queue.count} done${this.wish(queue)}`);
    const counts = Object.entries(queue.counts).filter(([name, n]) => n || ['placed', 'corrected', 'refused', 'misplaced'].includes(name));
    remake(byId('queue-counts'), counts, () => counts.map(([name, n]) => el('li', { className: n && ['refused', 'misplaced', 'faulted', 'aborted'].includes(name) ? 'bad' : name },
      el('strong', { textContent: String(n) }), el('small', { textContent: ENDS[name] ?? name }))));
    show(byId('queue-buttons'), !over);
    document.querySelectorAll('[data-parts]').forEach((button) => {
      button.disabled = !mine || button.dataset.parts === queue.wanted;
    });
  }

  wish({ state, wanted }) {
    if (state === 'holding') return ', HOLDS before the next part';
    return { hold: ', holds after this part', end: ', ends after this part' }[wanted] ?? '';
  }
}
