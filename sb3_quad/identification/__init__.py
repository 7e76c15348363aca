"""From logs of real flights to a vehicle file: read them, fit parameters, judge a file by them."""

from sb3_quad.base.imports import lazy_names, require

require("scipy", "fit", "what reads logs of flights")
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Fit": "sb3_quad.identification.fit",
        "Log": "sb3_quad.identification.flight_log",
        "fit_vehicle": "sb3_quad.identification.fit",
        "read_logs": "sb3_quad.identification.logs",
    },
)
