// The cameras' newest pictures with the board's points and the stripe that were found in them.

import { say, words } from './dom.js';

const OLD_S = 2;

export class Pictures {
  constructor(link) {
    this.link = link;
    this.newest = new Map();
    this.drawing = new Set();
    this.figures = new Map([...document.querySelectorAll('[data-camera]')].map((figure) => [figure.dataset.camera, figure]));
    link.on('picture', (picture) => this.came(picture));
    setInterval(() => this.ages(), 250);
  }

  // While one is drawn only the newest of those that come waits.
  async came(picture) {
    const { camera } = picture.header;
    this.newest.set(camera, picture);
    if (this.drawing.has(camera) || !this.figures.has(camera)) return;
    this.drawing.add(camera);
    let drawn = null;
    while (drawn !== this.newest.get(camera)) {
      drawn = this.newest.get(camera);
      await this.draw(drawn);
    }
    this.drawing.delete(camera);
  }

  async draw({ header, payload }) {
    const canvas = this.figures.get(header.camera).querySelector('canvas');
    let bitmap;
    try {
      bitmap = await createImageBitmap(new Blob([payload], { type: 'image/jpeg' }));
    } catch {
      return; // A picture that cannot be read is not shown; its age tells.
    }
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
    }
    canvas.parentElement.classList.remove('empty');
    const pen = canvas.getContext('2d');
    pen.drawImage(bitmap, 0, 0);
    bitmap.close();
    pen.lineWidth = Math.max(1, canvas.width / 400);
    pen.strokeStyle = '#19e06b';
    for (const [u, v] of header.board ?? []) {
      pen.beginPath();
      pen.arc(u, v, canvas.width / 130, 0, 7);
      pen.stroke();
    }
    pen.fillStyle = '#ffd21f';
    const size = Math.max(1.5, canvas.width / 320);
    for (const [u, v] of header.stripe ?? []) pen.fillRect(u - size / 2, v - size / 2, size, size);
  }

  ages() {
    const now = this.link.state ? this.link.state.t + this.link.age / 1e3 : null;
    for (const [camera, figure] of this.figures) {
      const header = this.newest.get(camera)?.header;
      if (!header || now === null) continue;
      const age = Math.max(0, now - header.t);
      figure.classList.toggle('old', age > OLD_S);
      const found = header.board?.length ? `, ${header.board.length} points of the board` : header.stripe?.length ? ', stripe' : '';
      say(figure.querySelector('output'), `${words(header.what)}${found}${age > OLD_S ? `, ${Math.round(age)} s ago` : ''}`);
    }
  }
}
