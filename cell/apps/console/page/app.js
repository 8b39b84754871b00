// The page: puts its parts together and gives each what the server tells.

import { legend } from './cloud.js';
import { devices, world } from './devices.js';
import { byId, el, remake, say, show } from './dom.js';
import { Jog } from './jog.js';
import { Link } from './link.js';
import { Pictures } from './pictures.js';
import { Question } from './question.js';
import { Queue } from './queue.js';
import { Replay } from './replay.js';
import { Runs } from './runs.js';
import { CellScene } from './scene.js';
import { Sequence } from './sequence.js';
import { status } from './status.js';

const link = new Link();
let cell = null;
let pathDrawn = null;
let sceneOf = null;

function stage() {
  try {
    return new CellScene(byId('stage'));
  } catch (problem) {
    show(byId('no-3d'), true);
    say(byId('no-3d'), `This browser draws no 3-D (${problem.message}). Everything else works; switch on WebGL to see the cell.`);
    return null;
  }
}

const scene = stage();
const sequence = new Sequence(link, ask);
const jog = new Jog(link, ask);
const question = new Question(ask);
const queue = new Queue(ask);
const runs = new Runs(link);
const replay = new Replay(link, (pose) => scene?.pose(pose), () => {
  scene?.showPresent(true);
  if (link.state) live(link.state);
});
new Pictures(link);

// What the page shows by itself when it was done.
const SHOWN = ['jog_step', 'start', 'home', 'calibrate', 'verify'];

// A command of the holder; a refusal is shown in the cell's own words.
async function ask(name, values) {
  // What was said before has had its time.
  if (name !== 'jog_step') show(byId('answer'), false);
  const answer = await link.do(name, values);
  if (!answer.ok || !SHOWN.includes(name)) notice(answer);
  return answer;
}

function notice(answer) {
  const box = byId('answer');
  box.classList.toggle('bad', !answer.ok);
  const rows = (answer.rows ?? []).map((row) => (typeof row === 'string' ? row : Object.values(row).join(' · ')));
  say(box.firstElementChild, [answer.text ?? '', ...rows].filter(Boolean).join('\n'));
  show(box, Boolean(box.firstElementChild.textContent));
  clearTimeout(notice.timer);
  if (answer.ok && !answer.rows) notice.timer = setTimeout(() => show(box, false), 6000);
}
byId('answer').lastElementChild.onclick = () => show(byId('answer'), false);

// --- STOP: on the way down, by both ways, never asked ---
async function stop() {
  const said = byId('stop-said');
  show(said, true);
  said.className = 'notice loud';
  say(said, 'STOP sent …');
  const answer = await link.stop();
  said.classList.toggle('done', answer.ok);
  say(said, answer.ok ? `STOP was carried out at ${new Date().toLocaleTimeString()}. ${answer.text ?? ''}` : `STOP NOT CONFIRMED: ${answer.text} Use the emergency stop.`);
  if (answer.ok) setTimeout(() => { if (said.classList.contains('done')) show(said, false); }, 8000);
}
byId('stop').addEventListener('pointerdown', stop);
byId('stop').addEventListener('click', (event) => { if (event.detail === 0) stop(); });

// --- who holds ---
const mine = () => Boolean(link.hello) && link.state?.holder === link.hello.id;
const myName = () => link.state?.clients.find((client) => client.id === link.hello?.id)?.name || byId('hold-name').value;
byId('hold-name').value = localStorage.getItem('name') ?? '';
byId('hold-form').onsubmit = (event) => {
  event.preventDefault();
  localStorage.setItem('name', byId('hold-name').value);
  ask('hold', { name: byId('hold-name').value });
};
byId('leave').onclick = () => ask('leave');
byId('hand-over').onchange = ({ target }) => {
  if (target.value) ask('hand_over', { to: target.value });
  target.value = '';
};
byId('clear-stop').onclick = () => ask('clear_stop', { by: myName() });
byId('recover').onclick = () => ask('recover', { by: myName() });

function hold(state) {
  const holder = state.clients.find((client) => client.id === state.holder);
  say(byId('holder'), mine() ? 'You hold the cell' : state.holder ? `${holder?.name || state.holder} holds the cell` : 'Nobody holds the cell');
  show(byId('hold-form'), !state.holder);
  show(byId('hold-mine'), mine());
  const others = state.clients.filter((client) => client.id !== link.hello?.id);
  remake(byId('hand-over'), others, () => [el('option', { value: '', textContent: 'Hand over to …' }),
    ...others.map((client) => el('option', { value: client.id, textContent: client.name || `screen ${client.id}` }))]);
  show(byId('hand-over'), others.length > 0);
  byId('clear-stop').disabled = byId('recover').disabled = !mine();
}

// --- what the server tells ---
link.on('hello', () => meet(null));
link.on('state', (told) => {
  if (!cell) return;
  const state = { ...told, starting: sequence.pending ?? told.starting };
  hold(state);
  status(state);
  world(cell, state);
  devices(state);
  sequence.state(state, mine());
  queue.state(state, mine());
  jog.state(state, mine());
  question.state(state, mine(), myName());
  if (!replay.on) live(state);
  const of = state.scene_of ?? state.run?.job ?? sceneOf;
  if (of !== sceneOf) meet(of);
});
link.on('answer', notice);
link.on('freshness', ({ stale, age }) => {
  document.body.classList.toggle('stale', stale);
  show(byId('lost'), stale);
  const since = Number.isFinite(age) ? ` for ${(age / 1e3).toFixed(0)} s` : '';
  if (stale) {
    say(byId('state'), 'NO LINK');
    byId('status').className = 'bad';
    say(byId('state-text'), 'What is shown is old.');
  }
  if (stale) say(byId('lost'), `NO CONNECTION to the cell${since}. What you see is old. STOP may not get through: use the emergency stop. ${link.refused}`);
});
link.on('cloud', ({ header, payload }) => {
  if (!scene) return;
  if (header.reset) scene.cloud.clear();
  const values = new Float32Array(payload);
  for (let k = 3; k < values.length; k += 4) values[k] *= 1e3;
  scene.cloud.add(values);
  say(byId('legend-count'), scene.cloud.count ? `${scene.cloud.count.toLocaleString()} points` : '');
});
link.on('replay', async (wish) => {
  screen('cell');
  try {
    if (wish.job && wish.job !== sceneOf) await meet(wish.job);
    await replay.open(wish);
    scene?.showPresent(false);
    byId('view').scrollIntoView({ block: 'nearest' });
  } catch (problem) {
    notice({ ok: false, text: problem.message });
  }
});

function live(state) {
  scene?.pose(state);
  if (state.path && state.path.n !== pathDrawn) scene?.path(state.path.points);
  if (state.path === null && pathDrawn !== null) scene?.path([]);
  pathDrawn = state.path?.n ?? null;
}

// Ask what the cell is and draw it, with the station of a job where one is named.
async function meet(job) {
  sceneOf = job;
  try {
    cell = await (await link.get(`/api/cell${job ? `?job=${encodeURIComponent(job)}` : ''}`)).json();
  } catch (problem) {
    notice({ ok: false, text: problem.message });
    return;
  }
  sceneOf = job ?? cell.job ?? null;
  say(byId('cell-name'), cell.name);
  document.title = `${cell.name} · assembly cell`;
  if (!job) {
    sequence.cell(cell);
    jog.cell(cell);
  }
  scene?.build(cell.scene ?? null);
  pathDrawn = null;
}

// --- the rest of the screen ---
function screen(name) {
  for (const other of ['cell', 'runs']) {
    show(byId(`screen-${other}`), other === name);
    byId(`tab-${other}`).setAttribute('aria-pressed', String(other === name));
  }
  if (name === 'runs') runs.load().catch((problem) => notice({ ok: false, text: problem.message }));
}
byId('tab-cell').onclick = () => screen('cell');
byId('tab-runs').onclick = () => screen('runs');
document.querySelectorAll('[data-view]').forEach((button) => { button.onclick = () => scene?.view(button.dataset.view); });

function scaled() {
  const limit = Number(byId('legend-limit').value);
  say(byId('legend-low'), `−${limit}`);
  say(byId('legend-high'), `+${limit} mm`);
  scene?.cloud.scale(limit);
}
byId('legend-limit').onchange = scaled;
legend(byId('legend-scale'));
scaled();
