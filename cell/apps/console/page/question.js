// A person has to decide: why, where the arm stands, what it was doing, what each choice does. Beside the 3-D view,
// never over it or over STOP, and never modal: everything else stays in reach.

import { byId, el, mm, say, show, words } from './dom.js';

const CHOICES = { confirm: 'I have looked: go on', again: 'Do it again', abort: 'End the run' };
const REASONS = {
  confirm: ['nothing touches the arm', 'removed what it touched', 'a person touched it'],
  refusal: ['wiped what was dirty', 'removed what was in the way', 'the light was changed', 'nothing is wrong: once more'],
};

export class Question {
  constructor(ask) {
    this.ask = ask;
    this.asked = null;
    this.box = byId('question');
  }

  // `mine` is whether this client may answer, `name` who answers.
  state(state, mine, name) {
    const question = state.question ?? null;
    const key = question && `${question.number} ${question.reason}`;
    if (key !== this.asked) {
      this.asked = key;
      if (question) this.box.replaceChildren(...this.content(question, state.run));
      if (question) this.box.focus();
    }
    show(this.box, question !== null);
    document.body.classList.toggle('asking', question !== null);
    if (question) say(this.stands, stands(state));
    if (question) this.box.querySelectorAll('button, select, textarea').forEach((control) => { control.disabled = !mine; });
    this.name = name;
  }

  content(question, run) {
    this.reason = el('textarea', { rows: 1, maxLength: 300, placeholder: 'why you decide so', 'aria-label': 'Your reason' });
    this.stands = el('p');
    const usual = (REASONS[question.kind] ?? []).map((text) => el('button', { type: 'button', textContent: text, onclick: () => { this.reason.value = text; } }));
    return [
      el('h2', { id: 'question-title', textContent: question.kind === 'refusal' ? 'Refused: what now?' : 'A person has to look' }),
      el('p', { className: 'why', textContent: question.reason }),
      el('p', { textContent: doing(question, run) }),
      this.stands,
      ...(question.numbers?.length ? [numbers(question.numbers)] : []),
      el('ul', { className: 'then' }, ...question.choices.map(({ choice }) => el('li', {}, el('strong', { textContent: `${CHOICES[choice]}: ` }), then(question, choice, run)))),
      ...(question.picture ? [el('img', { src: question.picture, alt: 'What the cell saw last' })] : []),
      el('div', { className: 'answer' },
        el('div', { className: 'choices', role: 'group', 'aria-label': 'Usual reasons' }, ...usual),
        this.reason,
        el('div', { className: 'buttons' }, ...question.choices.flatMap((choice) => this.choice(question, choice))),
        el('p', { className: 'bad', role: 'alert' })),
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

// What went on when the question came up.
function doing(question, run) {
  const what = words(question.step ?? run?.step ?? run?.kind);
  const attempt = run?.attempt > 1 ? `, attempt ${run.attempt}` : '';
  const far = run?.text ? `: ${run.text} (${Math.round(100 * run.fraction)} %)` : '';
  return `It was doing: ${what}${attempt}${far}.`;
}

// Where the arm stands and what else is safe to know before one steps near.
function stands({ flange, rail, laser, holding, vehicle }) {
  const at = flange ? `The flange stands at x ${mm(flange[0])}, y ${mm(flange[1])}, z ${mm(flange[2])} from the arm's base` : 'Where the arm stands is not known';
  return [at, rail === null ? '' : `rail at ${mm(rail)}`,
    { true: 'laser ON', false: 'laser off' }[laser], { true: 'a part in the claw', false: 'no part in the claw' }[holding],
    { true: 'vehicle braked', false: 'vehicle NOT BRAKED' }[vehicle?.braked]].filter(Boolean).join('; ') + '.';
}

// What a choice leads to; the server may say it in its own words.
function then(question, choice, run) {
  if (question.then?.[choice]) return question.then[choice];
  const step = words(question.step ?? run?.step ?? run?.kind);
  if (choice === 'confirm') return `the stop is cleared, the arm's program starts again, and ${step} begins anew. The arm moves at once: stand clear.`;
  if (choice === 'again') return `all steps from the chosen one on are done again. The cell moves at once: stand clear.`;
  return `the cell stays at rest where it stands, and the run ends as ${question.kind === 'refusal' ? 'refused' : 'aborted'}.`;
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
