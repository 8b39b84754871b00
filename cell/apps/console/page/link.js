// The link to the server: one WebSocket that shows the cell, POST for commands. A lost link is told at once.

const STALE_MS = 500;
const AGAIN_MS = 700;
const ANSWER_MS = 1500;
const SILENT = 'The server does not answer. Look whether `cell console` still runs.';

// What authorises this tab: it came behind the # of the link, and is in no cookie.
const [, entered] = location.hash.match(/^#key=([\w-]+)$/) ?? [];
if (entered) {
  sessionStorage.setItem('key', entered);
  history.replaceState(null, '', '/');
}
const KEY = sessionStorage.getItem('key') ?? 'none';

export class Link extends EventTarget {
  constructor() {
    super();
    this.heard = -Infinity;
    this.hello = null;
    this.state = null;
    this.stale = null;
    this.refused = '';
    this.connect();
    setInterval(() => this.look(), 100);
  }

  tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  on(type, heard) {
    this.addEventListener(type, (event) => heard(event.detail));
  }

  connect() {
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    const socket = new WebSocket(`${scheme}://${location.host}/live`, ['cell', KEY]);
    this.socket = socket;
    socket.binaryType = 'arraybuffer';
    socket.onmessage = ({ data }) => (typeof data === 'string' ? this.text(JSON.parse(data)) : this.binary(data));
    socket.onclose = () => {
      if (this.hello === null) this.why();
      this.hello = null;
      this.tell('closed');
      this.look();
      setTimeout(() => this.connect(), AGAIN_MS);
    };
  }

  // Why there is no link: a server that knows this browser no more says so in words.
  async why() {
    const answer = await fetch('/api/cell', { headers: { 'X-Cell-Key': KEY } }).catch(() => null);
    this.refused = answer?.status === 401 ? await answer.text() : '';
  }

  text(message) {
    if (message.type === 'state') {
      this.heard = performance.now();
      this.state = message;
      if (message.question?.picture) message.question.picture = this.ticketed(message.question.picture);
      this.look();
    } else if (message.type === 'hello') {
      this.hello = message;
    }
    this.tell(message.type, message);
  }

  binary(data) {
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    this.tell(header.type, { header, payload: data.slice(4 + length) });
  }

  // How old what is shown is, ms.
  get age() {
    return performance.now() - this.heard;
  }

  look() {
    const stale = this.age > STALE_MS;
    if (stale !== this.stale || stale) this.tell('freshness', { stale, age: this.age });
    this.stale = stale;
  }

  // Say something on the socket; false when there is none. Nothing is kept for later.
  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  // A command; gives the server's answer, {ok, text, …}, and never throws.
  async do(name, values = {}) {
    const key = name === 'stop' ? {} : { key: this.hello?.key ?? '' };
    try {
      const answer = await fetch('/api/do', {
        method: 'POST',
        headers: { 'Content-Type': 'application/json', 'X-Cell-Key': KEY },
        body: JSON.stringify({ do: name, ...key, ...values }),
        keepalive: name === 'stop',
        signal: name === 'stop' ? AbortSignal.timeout(ANSWER_MS) : undefined,
      });
      const told = await answer.text();
      return { ...(parsed(told) ?? { text: sentence(told, answer.status) }), ok: answer.ok };
    } catch {
      return { ok: false, error: 'no answer', text: SILENT };
    }
  }

  // Both ways at once, never queued.
  stop() {
    this.send({ type: 'stop' });
    return this.do('stop');
  }

  // The address of a picture or a report, which the browser itself asks for.
  ticketed(path) {
    return `${path}?ticket=${this.hello?.ticket ?? ''}`;
  }

  // What the server has; throws an error whose message is a sentence for people.
  async get(path) {
    const answer = await fetch(path, { headers: { 'X-Cell-Key': KEY } }).catch(() => { throw new Error(SILENT); });
    if (!answer.ok) throw new Error(sentence(await answer.text(), answer.status));
    return answer;
  }
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

// What a refusal says, in its own words; never the JSON that holds them.
function sentence(told, status) {
  const text = parsed(told)?.text ?? (/^\s*[{<[]/.test(told) ? '' : told.trim().slice(0, 300));
  const said = text || `The server refused this (${status}). Load the page again`;
  return said.charAt(0).toUpperCase() + said.slice(1) + (/[.!?]$/.test(said) ? '' : '.');
}
