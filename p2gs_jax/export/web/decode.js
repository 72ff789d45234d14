// Decodes the bytes of p2gs_jax/formats/packed.py.

function bytesOfBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Return triples of columns, interleaved: centres, logarithms of lengths, rotations (x y z of a
// unit quaternion), opacity (a logit and two zeros), then the channels of every harmonic.
async function decodeSplats(header, text) {
  const raw = await inflate(bytesOfBase64(text));
  const { count, chunk, bits } = header;
  const chunks = Math.ceil(count / chunk);
  const bounds = new Float32Array(raw.buffer, 0, bits.length * 2 * chunks);
  const triples = [];
  for (let k = 0; k < 4 + header.coefficients; k++) triples.push(new Float32Array(3 * count));
  let at = bounds.byteLength;
  bits.forEach((b, column) => {
    const place = column < 10 ? column : column + 2;
    const out = triples[Math.floor(place / 3)];
    const high = b > 8 ? at + count : -1;
    for (let i = 0; i < count; i++) {
      const c = Math.floor(i / chunk);
      const low = bounds[2 * column * chunks + c];
      const span = bounds[(2 * column + 1) * chunks + c] - low;
      const whole = raw[at + i] + (high < 0 ? 0 : 256 * raw[high + i]);
      out[3 * i + (place % 3)] = low + (whole * span) / (2 ** b - 1);
    }
    at += b > 8 ? 2 * count : count;
  });
  return { count, means: triples[0], triples };
}
