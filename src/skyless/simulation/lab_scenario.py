"""Named worlds."""

from skyless.simulation.impairments import Impairments


def lab_impairments(noise_ps: float) -> Impairments:
    """Return the lab of ``docs/maths.md`` section 5, for the site of ``skyless.site.lab``.

    Crystals of ±10 ppm with white FM 2·10⁻¹¹ and random-walk FM 10⁻⁹/√s, Gaussian noise of ``noise_ps`` on every TX
    and every RX stamp, stamps rounded to ticks, no loss and no obstacle.
    """
    return Impairments(tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps)
