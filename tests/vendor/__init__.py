"""The Chi.Bio driver against the vendor's own app on stand-ins of its electronics, judged by the truth of the vials.

    CHIBIO_APP=FOLDER python -m tests.vendor [bench=app] [faults=[...]] [workers=2]
    python -m tests.vendor bench=emulator

`bench.py` runs the app (or the emulator) and a client as processes, `link.py` is the cable between them, `faults.py`
what befalls them and by when it must be told and over, `judge.py` reads what a run leaves and compares it with the
truth.

CHIBIO_APP is the folder of the vendor's app.py, static/ and templates/ (HarrisonSteel/ChiBio; it has no licence and is
stored nowhere). CHIBIO_PYTHON is a Python with what it imports: gunicorn<21, flask, numpy, pyserial, simplejson.
The stand-ins are in ../shared/chibio_env beside the project, or in CHIBIO_STANDINS. Nothing here reads the code that
it judges.
"""
