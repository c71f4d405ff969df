//! Rows of planes, cut into bands that different threads may write at the same time.

use std::{
    marker::PhantomData,
    sync::atomic::{AtomicU64, Ordering},
};

/// The most bands that there can be.
pub const MOST: usize = 64;

/// Planes of `height` rows of `width` values, whose rows are handed out in bands, each of them once.
pub struct Bands<'a, T> {
    start: *mut T,
    planes: usize,
    height: usize,
    width: usize,
    /// Rows of a band; the last may have fewer.
    rows: usize,
    /// Values of a row that a band has; the last of those rows may have fewer.
    columns: usize,
    taken: AtomicU64,
    memory: PhantomData<&'a mut [T]>,
}

// SAFETY: what a thread gets are bands, each handed out once, and no two bands share a value.
unsafe impl<T: Send> Sync for Bands<'_, T> {}

impl<'a, T> Bands<'a, T> {
    /// Cuts `memory` into bands of so many rows, at most [`MOST`] of them.
    pub fn new(memory: &'a mut [T], shape: [usize; 3], rows: usize) -> Self {
        let columns = shape[2];
        Self::tiled(memory, shape, [rows, columns])
    }

    /// Cuts `memory` into bands of so many rows, and each of those into bands of so many columns, at most [`MOST`] in all. Those of
    /// the first rows come first.
    pub fn tiled(memory: &'a mut [T], [planes, height, width]: [usize; 3], [rows, columns]: [usize; 2]) -> Self {
        let count = height.div_ceil(rows.max(1)) * width.div_ceil(columns.max(1));
        assert!(
            planes * height * width <= memory.len() && count <= MOST && (height == 0 || rows > 0),
            "{planes} × {height} × {width}, {rows} × {columns}"
        );
        let (start, taken) = (memory.as_mut_ptr(), AtomicU64::new(0));
        Self { start, planes, height, width, rows, columns, taken, memory: PhantomData }
    }

    fn band(&self, number: usize) -> Option<Band<'_, T>> {
        let across = self.width.div_ceil(self.columns.max(1)).max(1);
        let (first, left) = ((number / across).checked_mul(self.rows)?, number % across * self.columns);
        (first < self.height).then(|| {
            let (end, right) = ((first + self.rows).min(self.height), (left + self.columns).min(self.width));
            Band { bands: self, first, end, left, right }
        })
    }

    /// The band of this number; nothing if there is none or somebody has it already.
    pub fn take(&self, number: usize) -> Option<Band<'_, T>> {
        let band = self.band(number)?;
        let bit = 1 << number;
        // Nothing else is told by this bit than whose the band is.
        let taken = self.taken.fetch_or(bit, Ordering::Relaxed) & bit != 0;
        (!taken).then_some(band)
    }
}

impl<T> Bands<'_, T> {
    /// The first band that nobody has, until who gets it lets go of it. Who is done with one soon finds it free again, with what is
    /// in the caches; [`Bands::take`] must not be used besides.
    pub fn lend(&self) -> Option<Lent<'_, T>> {
        loop {
            // Sees all that whoever let go of the band wrote to it.
            let taken = self.taken.load(Ordering::Acquire);
            let number = taken.trailing_ones();
            let band = self.band(number as usize)?;
            let (bit, order) = (1u64.checked_shl(number)?, Ordering::Acquire);
            if self.taken.compare_exchange_weak(taken, taken | bit, order, Ordering::Relaxed).is_ok() {
                return Some(Lent { band, bit });
            }
        }
    }
}

/// A band that is given back when this goes.
pub struct Lent<'a, T> {
    band: Band<'a, T>,
    bit: u64,
}

impl<T> Lent<'_, T> {
    /// The band's first row of the first plane.
    pub fn row(&mut self) -> &mut [T] {
        self.band.row(0, self.band.first)
    }
}

impl<T> Drop for Lent<'_, T> {
    fn drop(&mut self) {
        self.band.bands.taken.fetch_and(!self.bit, Ordering::Release);
    }
}

/// Some rows of every plane, or some columns of them.
pub struct Band<'a, T> {
    bands: &'a Bands<'a, T>,
    /// Its first row.
    pub first: usize,
    /// The row after its last.
    pub end: usize,
    /// Its first column.
    pub left: usize,
    /// The column after its last.
    pub right: usize,
}

impl<T> Band<'_, T> {
    /// A row of a plane, from the band's first column to its last.
    #[inline(always)]
    pub fn row(&mut self, plane: usize, row: usize) -> &mut [T] {
        let Bands { start, planes, height, width, .. } = *self.bands;
        assert!(plane < planes && row >= self.first && row < self.end);
        let (first, length) = ((plane * height + row) * width + self.left, self.right - self.left);
        // SAFETY: the columns of the row lie within the memory that `Bands::tiled` borrowed for good and measured; they belong to
        // this band alone, which was handed out once and is borrowed here.
        unsafe { std::slice::from_raw_parts_mut(start.add(first), length) }
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    #[test]
    fn every_row_is_handed_out_once() {
        let mut memory = vec![0.0; 2 * 5 * 3];
        let bands = Bands::new(&mut memory, [2, 5, 3], 2);
        for number in [2, 0, 1] {
            let mut band = bands.take(number).unwrap();
            assert_eq!((band.first, band.end), (2 * number, (2 * number + 2).min(5)));
            for row in band.first..band.end {
                band.row(1, row).fill(row as f32);
            }
            assert!(bands.take(number).is_none());
        }
        assert!(bands.take(3).is_none() && bands.take(usize::MAX).is_none());
        assert_eq!(memory[..15], [0.0; 15]);
        assert_eq!(memory[15..], [0., 0., 0., 1., 1., 1., 2., 2., 2., 3., 3., 3., 4., 4., 4.]);
    }

    #[test]
    fn columns_are_handed_out_apart() {
        let mut memory = vec![0; 2 * 3 * 5];
        let bands = Bands::tiled(&mut memory, [2, 3, 5], [2, 3]);
        for number in 0..4 {
            let mut band = bands.take(number).unwrap();
            let lengths = [band.end - band.first, band.right - band.left];
            assert_eq!(lengths, [[2, 3], [2, 2], [1, 3], [1, 2]][number]);
            for row in band.first..band.end {
                assert_eq!(band.row(1, row).len(), lengths[1]);
                band.row(1, row).fill(number + 1);
            }
            assert!(bands.take(number).is_none());
        }
        assert!(bands.take(4).is_none());
        assert_eq!(memory[15..], [1, 1, 1, 2, 2, 1, 1, 1, 2, 2, 3, 3, 3, 4, 4]);
        assert_eq!(memory[..15], [0; 15]);
    }

    #[test]
    fn what_is_lent_comes_back() {
        let mut memory = vec![0; 3 * 4];
        let bands = Bands::new(&mut memory, [1, 3, 4], 1);
        let (mut one, mut two) = (bands.lend().unwrap(), bands.lend().unwrap());
        one.row().fill(1);
        two.row().fill(2);
        drop(one);
        let (mut again, third) = (bands.lend().unwrap(), bands.lend().unwrap());
        assert_eq!(again.row(), [1; 4]);
        assert!(bands.lend().is_none());
        drop((again, third, two));
        (0..6000).into_par_iter().for_each(|_| {
            let mut band = bands.lend().unwrap();
            let before = band.row()[0];
            band.row().fill(before + 1);
        });
        assert_eq!(memory.chunks(4).map(|row| row[0]).sum::<i32>(), 3 + 6000);
        assert!(memory.chunks(4).all(|row| row == [row[0]; 4]));
    }
}
