//! A vector for every pixel, by a graph that sees in the older frame along which edges its cells divide.
//!
//! Each pixel's vector is a convex combination of those of the 5 × 5 cells around its own (Teed and Deng 2020, 3.3, of 3 × 3). The graph
//! reads their weights from the frame, the vectors and their expected errors (`training/upsampler.py`), so that it knows nothing of the
//! network but what it gives, and a refined vector is as good to it.

use std::env;

use tracing::info;

use crate::flow::{
    Canvas, Config, Error, Graph, Grid,
    manifest::{self, File},
    network::Raster,
    padding::{self, Padded},
};

/// What it takes: the older frame [1, 3, rows, columns], and of the raster flow [1, rows / 4, columns / 4, 2] and expected error
/// [1, rows / 4, columns / 4], in pixels of the image. It gives both at every pixel.
const INPUTS: usize = 3;
/// Pixels in a cell, along either side.
const CELL: usize = 4;

/// The graph and what it is shown.
pub(super) struct Upsampler {
    graph: Graph,
    file: File,
    image: Vec<f32>,
    /// The raster's vectors in pixels of the image.
    flow: Vec<f32>,
}

impl Upsampler {
    /// The one of the network that the settings name, if the manifest has one.
    pub(super) fn open(config: &Config) -> Result<Option<Self>, Error> {
        let folder = manifest::folder(&config.models, env::current_exe().ok().as_deref());
        let Some(file) = manifest::entry(&folder, &config.network)?.upsampler else {
            info!("{} has no upsampler: its flow is interpolated to full resolution", config.network);
            return Ok(None);
        };
        let graph = Graph::of(config, file.file.clone(), &manifest::read(&folder, &file)?, INPUTS)?;
        Ok(Some(Self { graph, file, image: vec![], flow: vec![] }))
    }

    /// Its file.
    pub(super) fn file(&self) -> &File {
        &self.file
    }

    /// Brings a raster's vectors and expected errors to the pixels of `grid`, which has as many as the frame. `confidence` of the canvas
    /// gets the errors.
    pub(super) fn enlarge(
        &mut self,
        older: &Padded<'_>,
        raster: &Raster<'_>,
        grid: &Grid,
        canvas: &mut Canvas<'_>,
    ) -> Result<(), Error> {
        let (width, height) = (older.width, older.height);
        self.image.resize(3 * width * height, 0.0);
        older.write(&mut self.image);
        let scale = older.exposed.scale;
        self.flow.clear();
        self.flow.extend(raster.flow.as_chunks::<2>().0.iter().flat_map(|[u, v]| [u / scale[0], v / scale[1]]));
        let (rows, columns) = (height / CELL, width / CELL);
        let tensors: [(&[f32], &[usize]); INPUTS] = [
            (&self.image, &[1, 3, height, width]),
            (&self.flow, &[1, rows, columns, 2]),
            (raster.uncertainty, &[1, rows, columns]),
        ];
        let (mut strange, mut given) = (None, 0);
        self.graph.run_into(&tensors, |at, shape, values| {
            given += 1;
            match (at, shape) {
                (0, [1, h, w, 2]) if [*h, *w] == [height as i64, width as i64] => {
                    padding::crop(values, width, canvas.flow, grid.width, 2);
                }
                (1, [1, h, w]) if [*h, *w] == [height as i64, width as i64] => {
                    padding::crop(values, width, canvas.confidence, grid.width, 1);
                }
                _ => strange = Some(format!("output {at} of {shape:?}")),
            }
        })?;
        if given < 2 {
            strange = Some(format!("{given} outputs"));
        }
        if let Some(found) = strange {
            let wanted = format!("outputs of [1, {height}, {width}, 2] and [1, {height}, {width}]");
            return Err(Error::Interface { file: self.file.file.clone(), wanted, found });
        }
        for [u, v] in canvas.flow.as_chunks_mut::<2>().0 {
            (*u, *v) = (*u * scale[0], *v * scale[1]);
        }
        Ok(())
    }
}
