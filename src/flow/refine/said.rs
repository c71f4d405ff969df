//! What the gradients alone say of the refined vectors, for those who weigh all cells' words together.

use super::pyramid::{Found, Sums};
use crate::flow::Gradients;

/// Planes of information (xx, xy, yy) and pull (right, down), camera pixels.
#[derive(Debug, Default)]
pub(super) struct Said {
    planes: [Vec<f32>; 5],
}

impl Said {
    /// Of cells' sums after [`centre`](super::pyramid::centre), at the corrections that were found; not of cells that were left where
    /// they are because their frames were more alike there (`before` is negative), for their sums are those of another place. `scale` is camera pixels per pixel.
    pub(super) fn take(&mut self, cells: &Sums, found: &Found, before: &[f32], scale: [f32; 2]) {
        let [xx, xy, yy, x, y, _, _, count, _] = cells.all();
        let [right, down] = &found.change;
        let per = scale.map(|scale| 1.0 / scale);
        self.planes.iter_mut().for_each(Vec::clear);
        for cell in 0..before.len() {
            // Asked this way round, a NaN says nothing. A cell whose frames differ by more than noise counts as it is: what weighs noise
            // by how large it came out would pass for knowing more.
            let known = before[cell] >= 0.0 && count[cell] > 0.0 && found.variance[cell] > 0.0;
            let (u, v) = (right[cell], down[cell]);
            let pull = [x[cell] - (xx[cell] * u + xy[cell] * v), y[cell] - (xy[cell] * u + yy[cell] * v)];
            let said = [
                xx[cell] * per[0] * per[0],
                xy[cell] * per[0] * per[1],
                yy[cell] * per[1] * per[1],
                pull[0] * per[0],
                pull[1] * per[1],
            ];
            let sound = known && said.iter().all(|value| value.is_finite());
            for (plane, value) in self.planes.iter_mut().zip(said) {
                plane.push(if sound { value } else { 0.0 });
            }
        }
    }

    /// As it is told.
    pub(super) fn told(&self) -> Gradients<'_> {
        let [xx, xy, yy, right, down] = &self.planes;
        Gradients { information: [xx, xy, yy], pull: [right, down] }
    }
}
