// A ruler for the page of a model: two clicks give the distance of two points on its surface.
//
// A click marks the depth at which half of the light is gone. The splats of viser's page are in a texture of 32-bit
// integers, two texels each: centre and group, then six half floats of the covariance, and the colour.
(() => {
  const button = document.querySelector('#warpgs-ruler'), marks = [], points = [];
  const halves = Float32Array.from({length: 65536}, (_, h) => {
    const e = (h >> 10) & 31, m = h & 1023;
    return (h & 0x8000 ? -1 : 1) * (e ? 2 ** (e - 15) * (1 + m / 1024) : m * 2 ** -24);
  });
  const splats = () => {
    let found = null;
    window.__viserMutable.scene.traverse(o => { found = o.material?.uniforms?.textureBuffer ? o.material.uniforms : found; });
    return found;
  };
  // z row and both image rows of the map from a group to (u, v, depth), linear at the centre (x, y, d)
  const image = (T, x, y, d) => {
    const [right, up, back] = [0, 4, 8].map(i => [T[i], T[i + 1], T[i + 2]]), ahead = back.map(v => -v);
    return [right.map((v, i) => (v - x / d * ahead[i]) / d), up.map((v, i) => (v - y / d * ahead[i]) / d), ahead];
  };
  const pick = (u, v, pixel) => {
    const s = splats(), n = Number(s.numGaussians.value), words = s.textureBuffer.value.image.data;
    const floats = new Float32Array(words.buffer), groups = s.textureT_camera_groups.value.image.data, hits = [];
    for (let i = 0; i < n; i++) {
      const a = 8 * i, T = groups.subarray(12 * words[a + 3], 12 * words[a + 3] + 12);
      const [x, y, z] = [0, 4, 8].map(r => T[r] * floats[a] + T[r + 1] * floats[a + 1] + T[r + 2] * floats[a + 2] + T[r + 3]);
      if (!(-z > s.near.value)) continue;
      const dx = u + x / z, dy = v + y / z, at = k => halves[words[a + 4 + (k >> 1)] >>> 16 * (k & 1) & 0xffff];
      const reach = 3.4 * Math.sqrt((at(0) + at(3) + at(5)) * (T[0] ** 2 + T[1] ** 2 + T[2] ** 2) * (1 + u * u + v * v)) / -z;
      if (Math.hypot(dx, dy) > reach + 2 * pixel) continue;
      const h = [0, 1, 2, 3, 4, 5].map(at), C = [[h[0], h[1], h[2]], [h[1], h[3], h[4]], [h[2], h[4], h[5]]], rows = image(T, x, y, -z);
      const cov = (p, q) => p.reduce((sum, v, j) => sum + v * C[j].reduce((t, c, k) => t + c * q[k], 0), 0);
      const [p, q, d] = rows;
      const pp = cov(p, p) + 0.3 * pixel ** 2, qq = cov(q, q) + 0.3 * pixel ** 2, pq = cov(p, q), det = pp * qq - pq * pq;
      const wx = (qq * dx - pq * dy) / det, wy = (pp * dy - pq * dx) / det;
      const alpha = (words[a + 7] >>> 24) / 255 * Math.exp(-0.5 * (dx * wx + dy * wy));
      if (alpha > 1 / 255) hits.push([-z, alpha, -z + cov(d, p) * wx + cov(d, q) * wy]);
    }
    let light = 1;
    for (const [, alpha, depth] of hits.sort((a, b) => a[0] - b[0])) if ((light *= 1 - alpha) < 0.5) return depth;
    return null;
  };
  const world = (M, x, y, z) => [0, 1, 2].map(r => M[r] * x + M[4 + r] * y + M[8 + r] * z + M[12 + r]);
  const clear = () => { marks.splice(0).forEach(m => m.remove()); points.length = 0; };
  const show = () => {  // marks follow the camera
    if (!marks.length) return;
    const c = window.__viserMutable.camera, P = c.projectionMatrix.elements, V = c.matrixWorldInverse.elements;
    points.forEach((at, i) => {
      const [x, y, z] = world(V, ...at);
      marks[i].style.left = (1 - P[0] * x / z) * innerWidth / 2 + 'px';
      marks[i].style.top = (1 + P[5] * y / z) * innerHeight / 2 + 'px';
    });
    requestAnimationFrame(show);
  };
  let down = null, on = false;
  button.addEventListener('click', () => {
    on = !on;
    clear();
    button.textContent = on ? 'Ruler: click two points' : 'Ruler';
  });
  addEventListener('pointerdown', e => { down = [e.clientX, e.clientY]; }, true);
  addEventListener('pointerup', e => {
    if (!on || !down || e.target.tagName !== 'CANVAS' || Math.hypot(e.clientX - down[0], e.clientY - down[1]) > 4) return;
    if (points.length > 1) clear();
    const c = window.__viserMutable.camera, P = c.projectionMatrix.elements;
    const u = (2 * e.clientX / innerWidth - 1) / P[0], v = (1 - 2 * e.clientY / innerHeight) / P[5];
    const depth = pick(u, v, 2 / (P[5] * innerHeight));
    if (depth === null) { button.textContent = 'Ruler: no surface there'; return; }
    points.push(world(c.matrixWorld.elements, u * depth, v * depth, -depth));
    const mark = document.createElement('div');
    mark.style.cssText = 'position:fixed;z-index:2;width:9px;height:9px;margin:-5px;border:1px solid #000;border-radius:9px;'
      + 'background:#fd3;pointer-events:none';
    marks.push(document.body.appendChild(mark));
    if (marks.length === 1) requestAnimationFrame(show);
    const length = points.length > 1 ? Math.hypot(...points[0].map((a, i) => a - points[1][i])) * SIZE : null;
    button.textContent = length === null ? 'Ruler: click the other point' : `Ruler: ${+length.toPrecision(4)} UNIT`;
  }, true);
})();
