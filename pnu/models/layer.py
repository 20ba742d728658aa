"""One layer: linear, batch norm, ReLU."""

from torch import Tensor, nn

from pnu.models.norm import BatchNorm


class Layer(nn.Module):
    """Linear, batch norm over all rows, ReLU: (..., width_in) -> (..., width_out).

    Without bias it is initialised as in PointNet++ (Kaiming, normal), else as a convolution of torch, both as released.
    """

    linear: nn.Linear
    norm: BatchNorm

    def __init__(self, width_in: int, width_out: int, *, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width_out, bias=bias)
        self.norm = BatchNorm(width_out)
        if not bias:
            nn.init.kaiming_normal_(self.linear.weight)

    def forward(self, x: Tensor, *, projected: bool = False) -> Tensor:
        """With `projected`, x holds the products with the weight, without bias."""
        rows = x.flatten(0, -2)
        if not projected:
            rows = self.linear(rows)
        elif self.linear.bias is not None:
            rows = rows + self.linear.bias
        return self.norm(rows).relu().view(*x.shape[:-1], -1)
