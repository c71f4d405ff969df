//! A level ground with boxes and poles on it, and what a ray meets there.

use nalgebra::{UnitQuaternion, Vector3};

use super::{
    noise::Normals,
    surface::{Albedo, Surface},
};

/// The world of a flight: z up, the ground at z = 0.
#[derive(Debug, Clone)]
pub(super) struct Scene {
    surface: Surface,
    blocks: Vec<Block>,
    /// Whether the ground is looked at so slantingly that a pixel covers far more of it along the view than across.
    slanting: bool,
}

/// A box with its sides along the world's axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    /// Where it stands now.
    pub(super) low: Vector3<f64>,
    pub(super) high: Vector3<f64>,
    /// From where it stood at first: what is on its faces moves with it.
    pub(super) moved: Vector3<f64>,
}

/// Where a ray ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// Along the ray, in lengths of its direction.
    pub(super) reach: f64,
    /// The block and the axis of its face; the ground has none.
    pub(super) block: Option<(usize, usize)>,
}

/// Columns and rows (first, last) of the image that a block may cover.
pub(super) type Bounds = [[f64; 2]; 2];

impl Scene {
    /// Obstacles along a track on the x axis from `begin` to `end` metres for a drone at `height`: clear of the track
    /// itself, so that the range finder sees the ground, and lower than the drone.
    pub(super) fn new(seed: u64, begin: f64, end: f64, height: f64, clear: f64) -> Self {
        let mut draws = Normals::new(seed, 0x5cee);
        let mut blocks = Vec::new();
        let mut x = begin;
        while x < end {
            x += height * (0.25 + 0.35 * draws.uniform());
            let pole = draws.uniform() < 0.5;
            let (wide, tall) = match pole {
                true => (0.02 + 0.02 * draws.uniform(), 0.3 + 0.3 * draws.uniform()),
                false => (0.06 + 0.14 * draws.uniform(), 0.08 + 0.22 * draws.uniform()),
            };
            let side = if draws.uniform() < 0.5 { -1.0 } else { 1.0 };
            let long = if pole { wide } else { wide * (0.6 + draws.uniform()) };
            let y = side * (clear + height * (0.5 * wide + 0.55 * draws.uniform()));
            let half = Vector3::new(0.5 * long, 0.5 * wide, 0.0) * height;
            let foot = Vector3::new(x, y, 0.0);
            blocks.push(Block::new(foot - half, foot + half + Vector3::z() * (tall * height)));
        }
        Self { surface: Surface::new(seed), blocks, slanting: false }
    }

    /// A ground that is looked at up to its horizon, with these blocks on and over it.
    pub(super) fn with(seed: u64, blocks: Vec<Block>) -> Self {
        Self { surface: Surface::new(seed), blocks, slanting: true }
    }

    /// The blocks as they stand.
    pub(super) fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// How far what a ray hit has moved.
    pub(super) fn moved(&self, hit: Hit) -> Vector3<f64> {
        hit.block.and_then(|(index, _)| self.blocks.get(index)).map_or_else(Vector3::zeros, |block| block.moved)
    }

    /// How far the ground, or what stands on it, is along the down axis of a body.
    pub(super) fn below(&self, position: &Vector3<f64>, attitude: &UnitQuaternion<f64>) -> Option<f64> {
        self.cast(position, &(attitude * -Vector3::z()), [0.0; 2], &[]).map(|hit| hit.reach)
    }

    /// The corners of each block, for [`Bounds`].
    pub(super) fn corners(&self) -> impl Iterator<Item = [Vector3<f64>; 8]> + '_ {
        self.blocks.iter().map(|block| {
            std::array::from_fn(|i| {
                Vector3::from_fn(|axis, _| if i >> axis & 1 == 0 { block.low[axis] } else { block.high[axis] })
            })
        })
    }

    /// What a ray meets first; `bounds` (one a block) spare the blocks that the pixel can't show.
    pub(super) fn cast(
        &self,
        from: &Vector3<f64>,
        ray: &Vector3<f64>,
        pixel: [f64; 2],
        bounds: &[Bounds],
    ) -> Option<Hit> {
        let mut best = (ray.z < -1e-9).then(|| Hit { reach: -from.z / ray.z, block: None });
        for (index, block) in self.blocks.iter().enumerate() {
            let outside = bounds
                .get(index)
                .is_some_and(|[x, y]| pixel[0] < x[0] || pixel[0] > x[1] || pixel[1] < y[0] || pixel[1] > y[1]);
            if outside {
                continue;
            }
            if let Some((reach, axis)) = block.enter(from, ray)
                && best.is_none_or(|hit| reach < hit.reach)
            {
                best = Some(Hit { reach, block: Some((index, axis)) });
            }
        }
        best
    }

    /// Light that comes back from where a ray ended, for a pixel `angle` wide.
    pub(super) fn shade(&self, from: &Vector3<f64>, ray: &Vector3<f64>, hit: Hit, angle: f64) -> Albedo {
        let point = from + ray * hit.reach;
        let footprint = angle * hit.reach;
        let Some((index, axis)) = hit.block else {
            if !self.slanting {
                return self.surface.ground(point.x, point.y, footprint);
            }
            // Along the view a pixel covers reach over height times as much, and two rays a pixel sample that.
            let along = 0.5 * footprint / ray.z.abs().max(1e-9);
            return self.surface.far_ground(point.x, point.y, footprint.max(along));
        };
        let point = point - self.blocks[index].moved;
        let face = (index * 4 + axis + 1) as u32;
        let (u, v) = match axis {
            0 => (point.y, point.z),
            1 => (point.x, point.z),
            _ => (point.x, point.y),
        };
        // The sky lights what lies open to it; a wall sees half of it, one side of a block less than the other.
        let open = [0.45, 0.6, 1.0][axis];
        self.surface.wall(u, v, face, footprint).map(|a| a * open)
    }
}

impl Block {
    /// A block between two corners.
    pub(super) fn new(low: Vector3<f64>, high: Vector3<f64>) -> Block {
        Block { low, high, moved: Vector3::zeros() }
    }

    /// The block after it moved by so much.
    pub(super) fn shifted(self, by: Vector3<f64>) -> Block {
        Block { low: self.low + by, high: self.high + by, moved: self.moved + by }
    }

    /// Where the ray enters, and through the faces of which axis.
    fn enter(&self, from: &Vector3<f64>, ray: &Vector3<f64>) -> Option<(f64, usize)> {
        let (mut near, mut far, mut through) = (0.0_f64, f64::INFINITY, 2);
        for axis in 0..3 {
            let inverse = 1.0 / ray[axis];
            let (a, b) = ((self.low[axis] - from[axis]) * inverse, (self.high[axis] - from[axis]) * inverse);
            let (enter, leave) = (a.min(b), a.max(b));
            if enter > near {
                (near, through) = (enter, axis);
            }
            far = far.min(leave);
        }
        (near > 0.0 && near < far).then_some((near, through))
    }
}
