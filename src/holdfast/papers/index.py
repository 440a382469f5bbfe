"""The papers that have been built, by the name the command gives them."""

from collections.abc import Callable

from holdfast.papers import care, decoder, decompose, integrity, nisme
from holdfast.papers.rows import Study

STUDIES: dict[str, Callable[[], Study]] = {
    "care": care.study,
    "decompose": decompose.study,
    "decoder": decoder.study,
    "integrity": integrity.study,
    "nisme": nisme.study,
}
