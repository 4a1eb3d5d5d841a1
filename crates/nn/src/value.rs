//! What a forward pass computes with.

use crate::error::Result;
use candle_core::{DType, Device, Shape, Tensor};

/// A tensor in a forward pass.
///
/// Operations of [`crate::ops`] take values and give values. Candle's own are out of reach, so that none of them can lose a
/// gradient silently: what leaves a pass goes through [`Value::detached`].
#[derive(Debug, Clone)]
pub struct Value {
    pub(crate) tensor: Tensor,
    /// its place on the tape, if it has a gradient there
    pub(crate) node: Option<usize>,
}

impl From<&Tensor> for Value {
    /// A constant.
    fn from(tensor: &Tensor) -> Self {
        Self::constant(tensor.detach())
    }
}

impl Value {
    pub(crate) fn constant(tensor: Tensor) -> Self {
        Self { tensor, node: None }
    }

    /// A tensor with its graph, for a pass on candle's operations.
    #[doc(hidden)]
    pub fn with_graph(tensor: &Tensor) -> Self {
        Self::constant(tensor.clone())
    }

    /// Its tensor with candle's graph.
    #[doc(hidden)]
    pub fn into_graph(self) -> Tensor {
        self.tensor
    }

    /// A constant of this shape.
    ///
    /// # Errors
    /// A number of values that is not the shape's.
    pub fn of(values: Vec<f32>, shape: impl Into<Shape>, device: &Device) -> Result<Self> {
        Ok(Self::constant(Tensor::from_vec(values, shape.into(), device)?))
    }

    /// Zeros.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn zeros(shape: impl Into<Shape>, device: &Device) -> Result<Self> {
        Ok(Self::constant(Tensor::zeros(shape, DType::F32, device)?))
    }

    /// Its tensor, without a gradient.
    pub fn detached(&self) -> Tensor {
        self.tensor.detach()
    }

    /// The same numbers as a constant.
    #[must_use]
    pub fn detach(&self) -> Self {
        Self::constant(self.tensor.detach())
    }

    /// The same numbers in another shape, without a copy.
    ///
    /// # Errors
    /// A shape of another size.
    pub fn reshape(&self, shape: impl Into<Shape>) -> Result<Self> {
        Ok(Self { tensor: self.tensor.reshape(shape.into())?, node: self.node })
    }

    /// Its sizes.
    pub fn dims(&self) -> &[usize] {
        self.tensor.dims()
    }

    /// One of its sizes.
    ///
    /// # Errors
    /// Fewer dimensions.
    pub fn dim(&self, axis: usize) -> Result<usize> {
        Ok(self.tensor.dim(axis)?)
    }

    /// Its two sizes.
    ///
    /// # Errors
    /// Another number of dimensions.
    pub fn dims2(&self) -> Result<(usize, usize)> {
        Ok(self.tensor.dims2()?)
    }

    /// Its three sizes.
    ///
    /// # Errors
    /// Another number of dimensions.
    pub fn dims3(&self) -> Result<(usize, usize, usize)> {
        Ok(self.tensor.dims3()?)
    }

    /// Its last size.
    pub fn width(&self) -> usize {
        self.dims().last().copied().unwrap_or(1)
    }

    /// Numbers in it.
    pub fn len(&self) -> usize {
        self.tensor.elem_count()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Where it is.
    pub fn device(&self) -> &Device {
        self.tensor.device()
    }
}
