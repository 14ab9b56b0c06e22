"""Research with Turbo-Pi, which never imports it.

command.py      `turbopi study`
studies/        one file a question, one form of report
small_policy/   how the policies that ship with Turbo-Pi were trained, and students of one denoising step
"""
