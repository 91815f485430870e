"""The plain twin, in NumPy, of what compiled code does for a line sensor's pixels."""

import numpy as np

from aolink.estimation import Profile
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics import batched
from aolink.optics.kernel import pixel_masses
from tests.kinds import must_be


class PlainView(PixelView):
    """A `PixelView` of a line sensor whose likelihood, modes and importance weights are those of NumPy."""

    @classmethod
    def of(cls, view):
        """The twin of a view."""
        twin = cls.__new__(cls)
        twin.__dict__.update(vars(view), on_line=False)
        return twin

    def moments(self, about):
        return WindowedMoments(self.sensor.profile).look(self.nodes, about, must_be(Profile, self.measured))

    def predicted(self, t):
        return self.linearised(t)[0]

    def linearised(self, t):
        path, w, pixel = self.paths(t)[:, :, 0], self.nodes.weights, self.optics.pixel_size
        mass, slope = pixel_masses(self.kernel[0, 0], self.optics.profile.edges, path, 1)
        f = batched.matmul(w[None], mass)[..., 0, :] / pixel
        return f, batched.long_matmul(np.swapaxes(slope * w[:, None], -1, -2), self.nodes.basis[0]) / pixel
