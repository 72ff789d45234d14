// A worker that sorts the Gaussians beyond the near plane by their exact depth, farthest first.

let means = null, near = 0;

onmessage = ({ data }) => {
  if (data.means) {
    means = data.means;
    near = data.near;
    return;
  }
  const [x, y, z, t] = data.row;
  const count = means.length / 3;
  const depths = new Float32Array(count);
  const rows = new Uint32Array(count);
  let seen = 0;
  for (let i = 0; i < count; i++) {
    const depth = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + t;
    if (depth > near) {
      depths[seen] = depth;
      rows[seen++] = i;
    }
  }
  const order = farthestFirst(new Uint32Array(depths.buffer, 0, seen), rows.subarray(0, seen));
  postMessage({ order }, [order.buffer]);
};

// Bits of positive floats sort like the floats, here in two stable passes of 16 bits.
function farthestFirst(keys, rows) {
  let from = rows.slice(), keysFrom = keys.slice();
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < keysFrom.length; i++) starts[65536 - ((keysFrom[i] >>> shift) & 65535)]++;
    for (let k = 1; k < starts.length; k++) starts[k] += starts[k - 1];
    const to = new Uint32Array(from.length), keysTo = new Uint32Array(from.length);
    for (let i = 0; i < from.length; i++) {
      const place = starts[65535 - ((keysFrom[i] >>> shift) & 65535)]++;
      to[place] = from[i];
      keysTo[place] = keysFrom[i];
    }
    from = to;
    keysFrom = keysTo;
  }
  return from;
}
