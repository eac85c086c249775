"""Reactors of the drivers' devices that are only read, beside whatever regulates them.

Nothing here can send a command: a Chi.Bio is asked by GET alone, a Pioreactor's broker is only listened to.
Entered by `deploy watch=true`.
"""
