//! What the ground and the obstacles of a synthetic flight look like: procedural, without end and without repetition.

/// Albedo of red, green and blue, 0…1.
pub(super) type Albedo = [f64; 3];

const GRASS: Albedo = [0.25, 0.30, 0.19];
const SOIL: Albedo = [0.38, 0.31, 0.24];
const GRAVEL: Albedo = [0.45, 0.44, 0.42];

/// The longest wavelength of the detail, metres; each octave halves it.
const LONGEST_M: f64 = 2.56;
const OCTAVES: i32 = 9;
/// Side of the square that holds at most one stone, metres.
const STONE_M: f64 = 0.4;

/// A surface, drawn from a seed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    seed: u32,
}

impl Surface {
    pub(super) fn new(seed: u64) -> Self {
        Self { seed: (seed ^ (seed >> 32)) as u32 }
    }

    /// The ground at (x, y) metres, for a pixel that covers `footprint` metres of it: what is finer is left out, so that
    /// nothing aliases.
    pub(super) fn ground(&self, x: f64, y: f64, footprint: f64) -> Albedo {
        self.land(x, y, footprint, |_| 1.0)
    }

    /// The same up to the horizon, where a pixel covers whole stones and meadows too.
    pub(super) fn far_ground(&self, x: f64, y: f64, footprint: f64) -> Albedo {
        self.land(x, y, footprint, |length| fades(length, footprint))
    }

    /// `shown` says how much is shown of what is so many metres long.
    fn land(&self, x: f64, y: f64, footprint: f64, shown: impl Fn(f64) -> f64) -> Albedo {
        let patches = |noise: f64, steep: f64, length: f64| {
            // What is no longer told apart is taken as half of each.
            let shown = shown(length);
            smooth(noise * steep) * shown + 0.5 * (1.0 - shown)
        };
        let meadow = patches(self.octave(x, y, 5.0, 91) - 0.42, 6.0, 5.0);
        let track = patches(self.octave(x, y, 2.2, 92) - 0.58, 8.0, 2.2);
        let mut albedo = mix(mix(SOIL, GRASS, meadow), GRAVEL, track);
        let (shade, cover) = self.stone(x, y, footprint);
        albedo = mix(albedo, [shade, shade, shade * 0.95], cover * shown(STONE_M));
        let light = 1.0 + 1.1 * self.detail(x, y, footprint, 0);
        albedo.map(|a| (a * light).clamp(0.02, 0.95))
    }

    /// A wall or a roof at (u, v) metres on its face; `face` tells faces apart.
    pub(super) fn wall(&self, u: f64, v: f64, face: u32, footprint: f64) -> Albedo {
        let tone = 0.15 + 0.5 * lattice(face as i32, 7, self.seed);
        let planks = 0.1 * (self.octave(u * 6.0, v * 0.7, 1.0, face) - 0.5);
        let light = 1.0 + 1.2 * self.detail(u, v, footprint, face) + planks;
        [tone * light, tone * 0.95 * light, tone * 0.85 * light].map(|a| a.clamp(0.02, 0.95))
    }

    /// Detail of every scale, about equally strong, as natural textures have it; mean 0.
    fn detail(&self, x: f64, y: f64, footprint: f64, salt: u32) -> f64 {
        let mut sum = 0.0;
        for k in 0..OCTAVES {
            let length = LONGEST_M / f64::from(1 << k);
            let visible = fades(length, footprint);
            if visible == 0.0 {
                break;
            }
            // Every octave is turned, or the lattices' axes would show.
            let (sine, cosine) = (0.7 * f64::from(k) + 0.3).sin_cos();
            let value = self.octave(x * cosine - y * sine, x * sine + y * cosine, length, salt * 16 + k as u32);
            sum += visible * (value - 0.5) * 0.55;
        }
        sum
    }

    /// Smooth value noise of one wavelength, 0…1.
    fn octave(&self, x: f64, y: f64, length: f64, salt: u32) -> f64 {
        let (x, y) = (x / length, y / length);
        let (column, row) = (x.floor(), y.floor());
        let (fx, fy) = (smooth(x - column), smooth(y - row));
        let (i, j) = (column as i32, row as i32);
        let seed = self.seed ^ salt.wrapping_mul(0x9e37_79b9);
        let upper = lattice(i, j, seed) * (1.0 - fx) + lattice(i + 1, j, seed) * fx;
        let lower = lattice(i, j + 1, seed) * (1.0 - fx) + lattice(i + 1, j + 1, seed) * fx;
        upper * (1.0 - fy) + lower * fy
    }

    /// Shade of the stone of this square, and how much of the pixel it covers.
    fn stone(&self, x: f64, y: f64, footprint: f64) -> (f64, f64) {
        let (column, row) = ((x / STONE_M).floor(), (y / STONE_M).floor());
        let draw = |salt: u32| lattice(column as i32, row as i32, self.seed ^ (0xabc0 + salt));
        if draw(0) > 0.5 {
            return (0.0, 0.0);
        }
        let radius = STONE_M * (0.06 + 0.3 * draw(1).powi(2));
        let room = STONE_M - 2.0 * radius;
        let (cx, cy) = (column * STONE_M + radius + room * draw(2), row * STONE_M + radius + room * draw(3));
        let cover = ((radius - (x - cx).hypot(y - cy)) / footprint.max(1e-3) + 0.5).clamp(0.0, 1.0);
        (0.08 + 0.75 * draw(4), cover)
    }
}

/// How much is shown of a wavelength: it fades out from four pixels a wavelength down to two.
fn fades(length: f64, footprint: f64) -> f64 {
    ((length / footprint - 2.0) / 2.0).clamp(0.0, 1.0)
}

/// A value in [0, 1) for a lattice point.
fn lattice(i: i32, j: i32, seed: u32) -> f64 {
    let mut h =
        i.cast_unsigned().wrapping_mul(0x9e37_79b1) ^ j.cast_unsigned().wrapping_mul(0x85eb_ca77).rotate_left(13);
    h = (h ^ seed).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 15)).wrapping_mul(0x297a_2d39);
    h = (h ^ (h >> 13)).wrapping_mul(0x85eb_ca6b);
    f64::from(h ^ (h >> 16)) / 4_294_967_296.0
}

/// 0…1 with level ends; clamps.
fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

fn mix(a: Albedo, b: Albedo, part: f64) -> Albedo {
    std::array::from_fn(|i| a[i] * (1.0 - part) + b[i] * part)
}
