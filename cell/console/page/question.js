// A person has to decide: why, what was seen, and the choices that the policy allows. Never over the STOP button, and
// never modal: everything else stays in reach.

import { byId, el, show, words } from './dom.js';

const CHOICES = { confirm: 'I have looked: go on', again: 'Do it again', abort: 'End the run' };

export class Question {
  constructor(ask) {
    this.ask = ask;
    this.asked = null;
    this.box = byId('question');
  }

  // `mine` is whether this client may answer, `name` who answers.
  state(question, mine, name) {
    const key = question && `${question.number} ${question.reason}`;
    if (key !== this.asked) {
      this.asked = key;
      if (question) this.box.replaceChildren(...this.content(question));
      if (question) this.box.focus();
    }
    show(this.box, question !== null);
    if (question) this.box.querySelectorAll('button, select, textarea').forEach((control) => { control.disabled = !mine; });
    this.name = name;
  }

  content(question) {
    this.reason = el('textarea', { rows: 2, maxLength: 300, placeholder: 'why you decide so', 'aria-label': 'Your reason' });
    const about = [question.step, question.code].filter(Boolean).map(words).join(' · ');
    return [
      el('h2', { id: 'question-title', textContent: question.kind === 'refusal' ? 'Refused: what now?' : 'A person has to look' }),
      el('p', { className: 'quiet', textContent: about }),
      el('p', { className: 'why', textContent: question.reason }),
      ...(question.picture ? [el('img', { src: question.picture, alt: 'What the cell saw' })] : []),
      ...(question.numbers?.length ? [numbers(question.numbers)] : []),
      this.reason,
      el('div', { className: 'buttons' }, ...question.choices.flatMap((choice) => this.choice(question, choice))),
      el('p', { className: 'bad', role: 'alert' }),
    ];
  }

  choice(question, { choice, steps }) {
    const from = steps?.length ? el('select', { 'aria-label': 'Again from' }, ...steps.map((name) => el('option', { value: name, textContent: `from ${words(name)}`, selected: name === steps.at(-1) }))) : null;
    const button = el('button', { type: 'button', textContent: CHOICES[choice] ?? words(choice), className: choice === 'abort' ? '' : 'main' });
    button.dataset.choice = choice;
    button.onclick = () => this.answer(question, choice, from?.value);
    return from ? [button, from] : [button];
  }

  async answer(question, choice, step) {
    const reason = this.reason.value.trim();
    const said = this.box.querySelector('[role=alert]');
    if (!reason) {
      said.textContent = 'Write down why; it goes into the record of the run.';
      this.reason.focus();
      return;
    }
    const answer = await this.ask('decide', { number: question.number, choice, ...(step ? { step } : {}), by: this.name, reason });
    if (!answer.ok) said.textContent = answer.text;
  }
}

export function numbers(rows) {
  const line = (row) => el('tr', { className: row.ok === false ? 'bad' : '' },
    el('th', { scope: 'row', textContent: words(row.name) }), el('td', { textContent: figure(row.value, row.unit) }),
    el('td', { textContent: row.limit === null || row.limit === undefined ? '' : figure(row.limit, row.unit) }),
    el('td', { textContent: row.ok === true ? 'kept' : row.ok === false ? 'NOT KEPT' : '' }));
  const heads = ['', 'is', 'limit', ''].map((text) => el('th', { textContent: text }));
  return el('table', { className: 'numbers' }, el('thead', {}, el('tr', {}, ...heads)), el('tbody', {}, ...rows.map(line)));
}

function figure(value, unit) {
  const text = typeof value === 'number' ? String(+value.toPrecision(4)) : String(value ?? '');
  return unit ? `${text} ${unit}` : text;
}
