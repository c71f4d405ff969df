//! The nearest surface among a sector's cells.

use super::cell::{Cell, hypot};

/// Cells within this many deviations are of one surface.
const SURFACE_SDS: f64 = 2.5;
/// The part of an error that all vectors share by which those of one sector differ.
const APART_PART: f64 = 0.25;
const ROUNDS: usize = 6;
/// Two groups of cells are two surfaces where their means are further apart than this many of their own deviations. Halves
/// of one Gaussian are 1.9 apart, halves of evenly spread values 2.4.
const APART_SDS: f64 = 2.8;
/// A thing is narrow where it fills less than this part of what a sector shows.
const NARROW_PART: f64 = 0.6;

/// Deviation of a cell beside its neighbours: what all vectors share moves them alike, and does not set them apart.
pub(super) fn sd(cell: &Cell, shared: f64) -> f64 {
    hypot(cell.sd, APART_PART * shared * cell.by_shift.norm())
}

/// Whether a cell may belong to a surface of this inverse time.
pub(super) fn holds(cell: &Cell, closing: f64, shared: f64) -> bool {
    (cell.closing - closing).abs() <= SURFACE_SDS * sd(cell, shared)
}

/// Leaves in `order` the cells of the nearest surface that at least `needed` of them make; none where there is no such.
pub(super) fn nearest(order: &mut Vec<u32>, cells: &[Cell], shared: f64, needed: usize) -> Option<()> {
    let all = order.len();
    let cell = |i: &u32| &cells[*i as usize];
    let least = |i: &u32| cell(i).closing - 2.0 * hypot(cell(i).sd, shared * cell(i).by_shift.norm());
    order.sort_unstable_by(|a, b| least(b).total_cmp(&least(a)).then(a.cmp(b)));
    let mut closing = cell(order.get(needed - 1)?).closing;
    for _ in 0..ROUNDS {
        let (mut sum, mut weights) = (0.0, 0.0);
        for cell in order.iter().map(cell).filter(|cell| holds(cell, closing, shared)) {
            let weight = 1.0 / sd(cell, shared).powi(2);
            (sum, weights) = (sum + weight * cell.closing, weights + weight);
        }
        if weights == 0.0 {
            return None;
        }
        closing = sum / weights;
    }
    // What cells state of themselves is more than they err by beside each other, so that one window may hold a narrow thing
    // and what is behind it: their own values tell the two apart.
    order.retain(|i| holds(cell(i), closing, shared));
    order.sort_unstable_by(|a, b| cell(b).closing.total_cmp(&cell(a).closing).then(a.cmp(b)));
    while let Some(count) = nearer(order.iter().map(|i| cell(i).closing), order.len(), needed) {
        order.truncate(count);
    }
    if order.len() < needed {
        return None;
    }
    if (order.len() as f64) < NARROW_PART * all as f64 {
        // The cells along a narrow thing's edges hold some of what is behind it, and drag a mean there: the densest half of
        // them is what the thing itself says.
        let half = order.len().div_ceil(2).max(needed);
        let width = |from: usize| cell(&order[from]).closing - cell(&order[from + half - 1]).closing;
        let densest = (0..=order.len() - half).min_by(|a, b| width(*a).total_cmp(&width(*b))).unwrap_or(0);
        order.copy_within(densest..densest + half, 0);
        order.truncate(half);
    }
    Some(())
}

/// How many of `count` values, greatest first, are a surface of their own before another: the split after which both
/// halves differ least from their means (Otsu 1979), where it is one. Both have at least `least` values.
fn nearer(values: impl Iterator<Item = f64> + Clone, count: usize, least: usize) -> Option<usize> {
    let (mut all, mut squares) = (0.0, 0.0);
    for value in values.clone() {
        (all, squares) = (all + value, squares + value * value);
    }
    let (mut sum, mut square, mut best) = (0.0, 0.0, None::<(f64, usize, f64)>);
    for (k, value) in values.enumerate().map(|(i, value)| (i + 1, value)) {
        (sum, square) = (sum + value, square + value * value);
        if k < least || k + least > count {
            continue;
        }
        let (near, far) = (k as f64, (count - k) as f64);
        let means = [sum / near, (all - sum) / far];
        let apart = means[0] - means[1];
        let within =
            (square / near - means[0] * means[0]).max(0.0) + ((squares - square) / far - means[1] * means[1]).max(0.0);
        let between = near * far * apart * apart;
        if best.is_none_or(|best| between > best.0) {
            best = Some((between, k, apart * apart / within.max(1e-18)));
        }
    }
    best.filter(|(_, _, apart)| *apart > APART_SDS * APART_SDS).map(|(_, k, _)| k)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells that state a deviation of 0.2 and err by a twentieth of it.
    fn cells(closings: &[(f64, usize)]) -> Vec<Cell> {
        let noise = |k: usize| (1..=4).map(|i| (k as f64 * 2.399 * i as f64 + i as f64).sin()).sum::<f64>();
        let one = |closing: f64, k: usize| Cell { closing: closing + 0.007 * noise(k), sd: 0.2, ..Cell::default() };
        closings.iter().flat_map(|&(closing, count)| (0..count).map(move |k| one(closing, k))).collect()
    }

    fn mean(closings: &[(f64, usize)]) -> Option<(f64, usize)> {
        let cells = cells(closings);
        let mut order: Vec<u32> = (0..cells.len() as u32).collect();
        nearest(&mut order, &cells, 0.0, 5)?;
        let sum: f64 = order.iter().map(|i| cells[*i as usize].closing).sum();
        Some((sum / order.len() as f64, order.len()))
    }

    #[test]
    fn a_wall_is_taken_whole() {
        let (closing, count) = mean(&[(0.4, 60)]).unwrap();
        assert!((closing - 0.4).abs() < 0.003 && count == 60, "{closing} of {count}");
    }

    #[test]
    fn a_narrow_thing_is_told_from_what_is_behind_and_from_its_own_edges() {
        let (closing, _) = mean(&[(0.05, 60), (0.18, 4), (0.3, 12)]).unwrap();
        assert!((closing - 0.3).abs() < 0.01, "{closing}");
    }

    #[test]
    fn too_few_cells_are_no_surface() {
        assert_eq!(mean(&[(0.4, 4)]), None);
        // Four near ones are wild vectors before a wall.
        let (closing, _) = mean(&[(0.05, 60), (3.0, 4)]).unwrap();
        assert!((closing - 0.05).abs() < 0.01, "{closing}");
    }
}
