// Head rotations: people think in pitch, yaw and roll, the service in axis-angle radians.
// R = Ry(yaw) Rx(pitch) Rz(roll); x to the person's left, y up, z out of the face.

const RADIAN = Math.PI / 180;

/** [pitch, yaw, roll] in degrees as axis-angle in radians. */
export function toAxisAngle([pitch, yaw, roll]) {
  const [x, y, z] = [pitch, yaw, roll].map((angle) => (angle * RADIAN) / 2);
  const [cx, cy, cz] = [x, y, z].map(Math.cos);
  const [sx, sy, sz] = [x, y, z].map(Math.sin);
  const w = cy * cx * cz + sy * sx * sz;
  const axis = [
    cy * sx * cz + sy * cx * sz,
    sy * cx * cz - cy * sx * sz,
    cy * cx * sz - sy * sx * cz,
  ];
  const sine = Math.hypot(...axis);
  const angle = 2 * Math.atan2(sine, w);
  return axis.map((part) => (sine < 1e-12 ? 0 : (part / sine) * angle));
}

/** Axis-angle in radians as [pitch, yaw, roll] in degrees. */
export function toDegrees(rotation) {
  const angle = Math.hypot(...rotation);
  if (angle < 1e-12) return [0, 0, 0];
  const [x, y, z] = rotation.map((part) => part / angle);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const sinPitch = x * s - y * z * (1 - c);
  const pitch = Math.asin(Math.max(-1, Math.min(1, sinPitch)));
  const yaw = Math.atan2(x * z * (1 - c) + y * s, c + z * z * (1 - c));
  const roll = Math.atan2(x * y * (1 - c) + z * s, c + y * y * (1 - c));
  return [pitch, yaw, roll].map((part) => part / RADIAN);
}
