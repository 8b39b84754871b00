// The place error of the jobs, oldest first, as a drawing: dots are measured, rings are stated, crosses were not placed.

const SPACE = 'http://www.w3.org/2000/svg';
const WIDTH = 720, HEIGHT = 180, LEFT = 46, BOTTOM = 24, TOP = 10;

function svg(tag, properties, ...children) {
  const made = document.createElementNS(SPACE, tag);
  Object.entries(properties).forEach(([name, value]) => made.setAttribute(name, value));
  made.append(...children);
  return made;
}

export function trend(points, open) {
  if (!points.length) return Object.assign(document.createElement('p'), { className: 'quiet', textContent: 'No job was run yet.' });
  const values = points.flatMap((point) => [point.d_mean_mm, point.expected_mm]).filter(Number.isFinite);
  const top = nice(Math.max(0.01, ...values));
  const x = (k) => LEFT + (WIDTH - LEFT - 12) * (points.length === 1 ? 0.5 : k / (points.length - 1));
  const y = (value) => HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * value / top;
  const lines = [0, 0.5, 1].map((share) => svg('g', { class: 'grid' },
    svg('line', { x1: LEFT, x2: WIDTH, y1: y(share * top), y2: y(share * top) }),
    svg('text', { x: LEFT - 6, y: y(share * top) + 4, 'text-anchor': 'end' }, String(+(share * top).toPrecision(3)))));
  const marks = points.map((point, k) => mark(point, x(k), y, open));
  const name = `Place error of ${points.length} jobs in mm, oldest first`;
  return svg('svg', { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: 'img', 'aria-label': name, class: 'trend' },
    ...lines, svg('text', { x: LEFT, y: HEIGHT - 6 }, 'mm, oldest to newest: ● true error of a simulated run, ○ stated uncertainty, ✗ not placed'), ...marks);
}

function mark(point, x, y, open) {
  const said = [`${point.run} ${point.job ?? ''}: ${point.outcome}`];
  const drawn = [];
  if (Number.isFinite(point.expected_mm)) {
    drawn.push(svg('circle', { cx: x, cy: y(point.expected_mm), r: 4, class: 'stated' }));
    said.push(`stated ${point.expected_mm.toFixed(3)} mm`);
  }
  if (Number.isFinite(point.d_mean_mm)) {
    drawn.push(svg('circle', { cx: x, cy: y(point.d_mean_mm), r: 4, class: 'measured' }));
    said.push(`error ${point.d_mean_mm.toFixed(3)} mm`);
  }
  if (point.outcome !== 'placed') drawn.push(svg('text', { x, y: y(0) - 3, 'text-anchor': 'middle', class: 'missed' }, '✗'));
  const group = svg('g', { class: 'mark' }, svg('title', {}, said.join(', ')), ...drawn);
  group.addEventListener('click', () => open(point.run));
  return group;
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].find((step) => step * power >= value) * power;
}
