// Each device: its state, who holds it, how its link does, its last error with what to do.

import { byId, el, remake, say, show, words } from './dom.js';

const CLEARED = /^(arm\.(protective_stop|link_lost)|vehicle\.trouble)$/;

export function devices(state) {
  const entries = Object.entries(state.devices);
  const faults = state.faults ?? [];
  const last = (name) => faults.findLast((fault) => fault.device === name || fault.text.includes(name)) ?? null;
  const rows = entries.map(([name, device]) => [name, device, last(name)]);
  remake(byId('device-list'), rows.map(([name, device, met]) => [name, device.simulated, device.fault, device.errors, met]), () => rows.map(row));
  entries.forEach(([name, device], k) => refresh(byId('device-list').children[k], name, device));
  // With no run to ask about it: a person clears it here.
  const ill = state.run === null ? entries.map(([, device]) => device.fault).find((met) => CLEARED.test(met?.code)) : null;
  show(byId('unlock'), Boolean(ill));
  if (ill) say(byId('unlock').firstElementChild, `${ill.text}. Nothing clears it by itself. `);
  show(byId('busy'), Boolean(state.busy) && state.run === null);
  say(byId('busy'), state.busy ?? '');
  show(byId('stopped'), Boolean(state.safety?.stopped) && state.run === null);
}

const told = (fault) => [fault.text, fault.remedy].filter(Boolean).join(' → ');

function row([name, device, met]) {
  const errors = Object.entries(device.errors ?? {}).filter(([, count]) => count);
  return el('li', {},
    el('span', { className: 'lamp', 'aria-hidden': 'true' }),
    el('strong', { textContent: words(name) }),
    el('span', { className: `kind ${device.simulated ? 'sim' : 'real'}`, textContent: device.simulated ? 'sim' : 'REAL' }),
    el('span', { className: 'what' }),
    el('small', { className: 'link' }),
    ...(errors.length ? [el('small', { className: 'errors', textContent: errors.map(([what, count]) => `${count} ${words(what)}`).join(', ') })] : []),
    ...(device.fault ? [el('p', { className: 'fault', textContent: told(device.fault) })] : []),
    ...(met && !device.fault ? [el('p', { className: 'met', title: told(met), textContent: met.over ? `earlier run: ${met.text}` : `last: ${told(met)}` })] : []));
}

function refresh(item, name, device) {
  item.classList.toggle('bad', !device.ok);
  say(item.querySelector('.what'), device.state ?? '');
  const held = device.held_by ? `held by ${words(device.held_by)}` : '';
  const trip = device.rtt_ms === null || device.rtt_ms === undefined ? '' : `${device.rtt_ms.toFixed(1)} ms`;
  say(item.querySelector('.link'), [held, trip].filter(Boolean).join(' · '));
}

byId('device-details').onclick = ({ target }) => {
  target.setAttribute('aria-pressed', String(byId('devices').classList.toggle('detailed')));
};

// Simulated or real, and which: always in sight.
export function world(cell, state) {
  const pill = byId('world');
  const simulated = state?.simulated ?? cell.simulated;
  if (simulated === true) {
    say(pill, `SIMULATED · seed ${cell.seed} · ${cell.level}${cell.speed !== 1 ? ` · ${+cell.speed.toFixed(1)}× time` : ''}`);
    pill.className = 'pill sim';
  } else if (simulated === false) {
    say(pill, 'REAL DEVICES');
    pill.className = 'pill real';
  } else {
    const real = cell.devices.map((device) => device.name).filter((name) => !simulated.includes(name));
    say(pill, `REAL: ${real.map(words).join(', ')} · simulated: ${simulated.map(words).join(', ')}`);
    pill.className = 'pill real';
  }
}
