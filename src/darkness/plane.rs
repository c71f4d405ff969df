//! What every measure of a plane asks of it first: as many values as its size says, and all of them finite.

/// Why values are no plane.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A plane does not have width × height values.
    #[error("a plane of {width}×{height} needs {expected} values, found {found}")]
    Length {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Columns × rows.
        expected: usize,
        /// Values that came.
        found: usize,
    },
    /// NaN or infinite.
    #[error("pixel ({column}, {row}) is {value}, expected a finite value")]
    Value {
        /// Column.
        column: usize,
        /// Row.
        row: usize,
        /// As found.
        value: f32,
    },
}

pub(super) fn check(plane: &[f32], width: usize, height: usize) -> Result<(), Error> {
    let expected = width * height;
    if plane.len() != expected {
        return Err(Error::Length { width, height, expected, found: plane.len() });
    }
    match plane.iter().position(|value| !value.is_finite()) {
        Some(at) => Err(Error::Value { column: at % width, row: at / width, value: plane[at] }),
        None => Ok(()),
    }
}
