"""Reactors that are only read, while another program regulates them.

Nothing here can send a command: a Chi.Bio gets only GET requests, a Pioreactor's broker only subscriptions.
`deploy watch=true` uses it.
"""
